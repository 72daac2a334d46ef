"""Random stories of what may happen to a service, judged by one who knows the truth."""
