"""Which bodies touch the floor and which touch which box, from a model's contact sensors.

Sensors and not ``data.contact``: a batch steps many worlds on one ``MjData``, whose contacts are only the last world's.
"""

from __future__ import annotations

import copy

import mujoco
import numpy as np
from numpy.typing import NDArray

from egopose.motion.rotations import Array


class ContactSensors:
    """Where a compiled model's contact sensors leave what they found.

    Args:
        model: with the sensors of :func:`egopose.humanoid.boxes.with_boxes`.

    Raises:
        ValueError: it has none, or a body lacks that for the floor or for a box.
    """

    def __init__(self, model: mujoco.MjModel) -> None:
        ours = np.flatnonzero(model.sensor_type == mujoco.mjtSensor.mjSENS_CONTACT).tolist()
        if not ours:
            raise ValueError("the model has no contact sensors: egopose.humanoid.boxes.with_boxes adds them")
        #: ``[E]`` MuJoCo ids of the bodies, in the sensors' order.
        self.bodies = np.array(list(dict.fromkeys(int(model.sensor_objid[s]) for s in ours)))
        row = {body: e for e, body in enumerate(self.bodies.tolist())}
        self._columns = np.full((len(row), 1 + model.nmocap), -1)
        for s in ours:
            other = int(model.sensor_refid[s])
            of_box = model.sensor_reftype[s] == mujoco.mjtObj.mjOBJ_BODY
            column = 1 + int(model.body_mocapid[other]) if of_box else 0
            self._columns[row[int(model.sensor_objid[s])], column] = model.sensor_adr[s]
        if (self._columns < 0).any():
            raise ValueError("every body with contact sensors needs one for the floor and one for each box")

    @property
    def shape(self) -> tuple[int, int]:
        """``(E, 1 + K)``."""
        return self._columns.shape[0], self._columns.shape[1]

    def read(self, sensordata: Array) -> NDArray[np.bool_]:
        """``[n, E, 1 + K]`` of ``sensordata [n, S]``: touching the floor, then each box."""
        return sensordata[:, self._columns] > 0


def without_sensors(model: mujoco.MjModel) -> mujoco.MjModel:
    """A model that does not work out its sensors: itself where it has none."""
    if not model.nsensor:
        return model
    model = copy.copy(model)
    model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_SENSOR
    return model
