"""What comes out: reconstructions, what they rest on, and the reports on the way there."""
