"""``python -m egopose.prepare data=... [key=value]``: make the take store of a data set, resumable."""

from __future__ import annotations

from egopose.runtime import prepare_runtime

prepare_runtime()

import sys  # noqa: E402

from omegaconf import DictConfig  # noqa: E402

from egopose.config import command, register_resolvers, resolved  # noqa: E402
from egopose.errors import InputError  # noqa: E402

register_resolvers()


@command("prepare")
def main(config: DictConfig) -> None:
    """Hydra's entry."""
    from egopose.data.preparation import prepare
    from egopose.data.report import store_report

    try:
        store = prepare(resolved(config))
    except InputError as error:
        print(f"error: {error}", file=sys.stderr)
        raise SystemExit(2) from None
    print(store_report(store))


if __name__ == "__main__":
    main()
