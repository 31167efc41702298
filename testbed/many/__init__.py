"""More than one run: campaigns and checks."""
