"""One module a verb of ``python -m egopose.bench``, each with ``run(overrides, rounds) -> dict``."""
