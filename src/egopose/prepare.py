"""``python -m egopose.prepare data=... [key=value]``: make the take store of a data set, resumable."""

from __future__ import annotations

import sys

from omegaconf import DictConfig

from egopose.core.config import command, register_resolvers, resolved
from egopose.core.errors import InputError

register_resolvers()


@command("prepare")
def main(config: DictConfig) -> None:
    """Hydra's entry."""
    from egopose.data.preparation import prepare
    from egopose.data.report import store_report

    try:
        values = resolved(config)
        if values["stages"] not in ("all", "motion"):
            raise InputError("conf/prepare.yaml", "stages", f"must be all or motion, not {values['stages']!r:.60}")
        store = prepare(values, flow=values["stages"] == "all")
    except InputError as error:
        print(f"error: {error}", file=sys.stderr)
        raise SystemExit(2) from None
    print(store_report(store, values["data"]["split"]))


if __name__ == "__main__":
    main()
