from __future__ import annotations

import pytest
from worlds.held_memory import held

from crowdmap_torch.processes.memory import peak_bytes
from crowdmap_torch.studies.spent import spent


@pytest.mark.skipif(peak_bytes() is None, reason="memory is read in /proc")
def test_the_peak_is_that_of_the_stage():
    stages: dict[str, dict[str, float]] = {}
    with spent(stages, "large"), held(120_000_000):
        pass
    with spent(stages, "small"):
        total = sum(range(1000))
    assert total == 499_500 and 0 <= stages["small"]["seconds"] < 5
    # Held in the first alone.
    assert stages["large"]["peak_mb"] - stages["small"]["peak_mb"] == pytest.approx(120, abs=20)
