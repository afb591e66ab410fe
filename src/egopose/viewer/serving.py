"""A viser server behind the door, with a floor and a camera."""

from __future__ import annotations

import io
from contextlib import redirect_stdout

import numpy as np
import viser

from egopose.motion.rotations import Array
from egopose.viewer.auth_proxy import Address, AuthProxy


class Server(viser.ViserServer):
    """Without the tunnel to a public server that any page connected to viser may ask for."""

    def request_share_url(self, verbose: bool = True) -> str | None:
        return None


def open_server(address: Address) -> tuple[Server, AuthProxy, str]:
    """The server, the door before it and what to open in a browser.

    Raises:
        InputError: the address cannot be listened at.
    """
    with redirect_stdout(io.StringIO()):  # its banner names an address that is not the door's
        server = Server("127.0.0.1", 0, label="egopose", verbose=False)
    try:
        door = AuthProxy(address, server.get_port())
    except Exception:
        server.stop()
        raise
    shown = "localhost" if address.host in ("0.0.0.0", "::") else address.host
    return server, door, f"http://{shown}:{door.port}/" + (f"?token={address.token}" if address.token else "")


def furnish(server: Server) -> tuple[viser.FrameHandle, viser.GridHandle]:
    """A floor and the first look; returns the frame all bodies stand in, and the floor."""
    server.gui.configure_theme(show_logo=False, show_share_button=False, control_width="large")
    server.gui.main_panel.dock_right()
    server.scene.set_up_direction("+z")
    world = server.scene.add_frame("/world", show_axes=False)
    cell, section = (215, 215, 215), (180, 180, 180)
    floor = server.scene.add_grid("/world/floor", width=20, height=20, cell_color=cell, section_color=section)
    server.initial_camera.position = (2.6, -2.2, 1.5)
    server.initial_camera.look_at = (0.0, 0.0, 0.9)
    return world, floor


def tile(root: Array) -> tuple[float, float, float]:
    """Where the floor is under ``root [3]``, its lines staying where they are: it ends ten metres from its middle."""
    return float(np.round(root[0])), float(np.round(root[1])), 0.0
