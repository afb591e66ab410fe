"""From a configuration to the kinematic forecasts a policy follows: trained once a run, kept in ``RUN_DIR/forecaster``.

Forecasts that begin at training frames are those of networks that have not seen the frames around them, nor any they
forecast: a policy must not trust them more than it may on new takes.
"""

from __future__ import annotations

FOLDER = "forecaster"
#: Components of that folder that forecasts are made by; ``forecasts`` are those of the training frames.
PARTS = ("members", "kernel", "sizes", "continued")
