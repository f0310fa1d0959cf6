"""The checker of annotations that `CROWDMAP_CHECK_SHAPES=1` puts on every function of the package."""

from __future__ import annotations

from beartype import BeartypeConf, beartype

checked = beartype(conf=BeartypeConf(is_pep484_tower=True))
"""Types and shapes of arguments and results; an int will do for a float, as for every type checker."""
