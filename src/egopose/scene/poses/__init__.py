"""Poses of a filmed person: readers, estimators, and what mends them."""
