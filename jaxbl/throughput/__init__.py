"""How fast: the paper's chain on many lanes, by this package and by everyone else on the same work.

What rivals run is written once more in each one's own way (`rivals`), and used nowhere else.
"""

from .run import BenchResult as BenchResult, bench as bench
