"""Methods of other papers (Table 1 of Xi et al. 2024) for comparison with ours; not part of the product."""

import soilbus  # noqa: F401  # before numpy, which it keeps to one thread
