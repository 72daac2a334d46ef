"""Fuzz targets of everything that reads what others wrote."""
