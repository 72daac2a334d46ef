"""Published points of single wheels through the diagnosis; rigs/*.toml has the wheels and assumed errors."""
