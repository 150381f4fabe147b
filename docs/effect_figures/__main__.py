"""Draw pictures into a folder."""

import sys
from pathlib import Path

from effect_figures import draw_all

draw_all(Path(sys.argv[1]), sys.argv[2:])
