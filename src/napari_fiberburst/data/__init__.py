"""What comes in: bursts of frames."""
