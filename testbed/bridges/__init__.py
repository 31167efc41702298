"""Other people's autopilots in the loop: each module speaks the protocol by which one takes a simulator's sensors."""
