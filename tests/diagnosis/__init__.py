import soilbus  # noqa: F401  # before numpy, which it keeps to one thread
