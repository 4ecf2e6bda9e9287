"""Long trials of what is promised of files, memory, processes and faults: `make soak`."""
