"""What the paper says of its map (Dabeer et al. 2017, VI), to be drawn beside ours.

31 surveyed signs, surface roads of San Diego. Its figures themselves are not in the text: these are the points that it
names.
"""

from __future__ import annotations

JOURNEYS = 25
"""With so many "the error floors"."""
ABSOLUTE_M = 0.17
"""Mean absolute error of sign corners there."""
RELATIVE_M = 0.14
"""Mean relative error there."""
BUNDLE_GAIN = (0.05, 0.10)
"""Share of the error that bundle adjustment takes off: "only around 5 % to 10 %, within the error margins"."""
LOSS_FROM_JOURNEYS = 15
"""With more journeys than this ..."""
DATA_LOSS = 0.01
"""... singletons are "around 1 % of all the data"."""
