"""Finds where the time cursor of an open viewer stands."""

from __future__ import annotations

from rerun.experimental import ViewerClient

from physx_core.errors import VisualizerError

USUAL_PORT = 9876
"""Where Rerun's viewers listen if they are not told otherwise."""


def find_cursor(address: str) -> tuple[str, int]:
    """Return the timeline and the position of a viewer's cursor.

    Args:
        address: Address of the viewer, ``HOST:PORT``.

    Raises:
        VisualizerError: If there is no viewer, or no recording in it.
    """
    try:
        state = ViewerClient.connect(f"rerun+http://{address}/proxy").get_state()
    except OSError as error:
        raise VisualizerError(
            f"There is no viewer at {address}: open one with physx view DATASET --live."
        ) from error
    for recording in state.recordings:
        is_shown = recording.store_id == state.active_recording
        if is_shown and recording.current_timeline and recording.current_time is not None:
            return recording.current_timeline, recording.current_time
    raise VisualizerError(f"The viewer at {address} shows no recording.")
