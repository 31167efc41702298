"""What a run is made of: the reference motion, increments and samples."""
