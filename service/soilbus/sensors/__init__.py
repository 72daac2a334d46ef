"""Is this reading to be believed: what recordings say of their own sensors."""
