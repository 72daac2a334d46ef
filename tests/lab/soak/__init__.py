"""Days of driving through the daemon's own loop, with faults arriving at random and the clock injected."""
