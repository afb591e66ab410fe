"""A camera's settings from its telemetry, and whether what it did to the picture can be undone."""

from __future__ import annotations

from dataclasses import replace
from os import PathLike

from egopose.core.errors import InputError
from egopose.vision.lens import Camera
from egopose.vision.telemetry.lens_fields import is_pinhole
from egopose.vision.telemetry.samples import Telemetry


def camera_from_telemetry(telemetry: Telemetry, camera: Camera) -> Camera:
    """The camera with what its file says in place of what the user left null.

    A *linear* picture is a pinhole's; all other modes of a GoPro are taken for a fisheye. Superview and hyperview also
    stretch the sides, which no setting here undoes.

    Args:
        telemetry: of the film.
        camera: the user's settings, which win. The kind of lens and its angle go together: where the user set the
            field of view, the file's angle is not taken.

    Raises:
        InputError: the file's values and the user's do not fit together; names the setting.
    """
    field_of_view = camera.field_of_view
    if field_of_view is None:
        field_of_view = telemetry.field_of_view
    lens = camera.lens
    if lens is None and telemetry.lens is not None and field_of_view is not None:
        lens = "pinhole" if is_pinhole(telemetry.lens) else "fisheye"
    readout = telemetry.readout if camera.readout is None else camera.readout
    return replace(camera, field_of_view=field_of_view, lens=lens, readout=readout)


def require_undoable(telemetry: Telemetry, path: str | PathLike[str]) -> None:
    """See that a steadied picture comes with what undoes it.

    Raises:
        InputError: the camera steadied the picture, and the file does not say by how much.
    """
    if telemetry.stabilised and telemetry.image_orientation is None:
        cause = "the camera steadied the picture and the file does not say by how much: film with HyperSmooth off, or"
        raise InputError(path, "stabilised", f"{cause} go on anyway with camera.stabilised=ignore")
