"""Places for the wearer to be seen in, beside the plain rooms: one file a kind, drawn from a seed around a way."""
