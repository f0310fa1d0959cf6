"""The map of report.html: the viewer, with everything that the run knows."""

from __future__ import annotations

from crowdmap_torch.report.record import RunRecord
from crowdmap_torch.viewer.page import viewer_element
from crowdmap_torch.viewer.scene import Scene


def map_section(record: RunRecord) -> str:
    """The viewer of a run as an element of the report; rows of the table of signs lead to it by their `data-id`."""
    return viewer_element(
        Scene(
            kind="run",
            title=record.title,
            subtitle=", ".join(record.facts.values()),
            origin=record.hd_map.origin,
            hd_map=record.hd_map,
            map_before=record.map_before,
            survey=record.survey,
            drives=record.drives,
            outcomes=record.outcomes,
        )
    )
