"""What soilbus said of fixed recordings, kept to be compared with what it says of them now."""
