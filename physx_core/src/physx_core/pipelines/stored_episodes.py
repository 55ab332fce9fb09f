"""The episodes that an earlier run had begun: their rows in the dataset, their states beside it."""

from __future__ import annotations

from physx_core.config import EnvironmentConfig
from physx_core.dataset import Dataset
from physx_core.pipelines.campaign import Campaign
from physx_core.session import Session
from physx_core.workers.lease import Begun
from physx_core.workers.pasts import PastFiles


def find_begun(
    session: Session, dataset: Dataset, campaign: Campaign, config: EnvironmentConfig
) -> tuple[PastFiles | None, dict[int, Begun]]:
    """Return what keeps the states of a campaign's episodes, and those that can go on.

    Args:
        session: Where the states are.
        dataset: The session's dataset, open for writing.
        campaign: The campaign.
        config: The environment.

    Returns:
        None if there are no states; and for the number of an episode what is stored of it.

    Raises:
        DatasetError: If states of an earlier run cannot be removed.
    """
    if not config.state_every:
        return None, {}
    run = f"episodes {campaign.mode} {campaign.number} {campaign.seed}"
    states = PastFiles(session.path / "states", run)
    known = dataset.unfinished_episodes(campaign.mode, campaign.number)
    if not known:
        states.clear()
        return states, {}
    pasts = states.read(lambda number, past: past.rows <= known.get(number, (0, 0))[1])
    return states, {n: Begun(*known[n], past.rows, past.state) for n, past in pasts.items()}
