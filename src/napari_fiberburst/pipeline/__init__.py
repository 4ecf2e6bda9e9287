"""The pipeline: the steps of the method strung together, reported while they happen."""
