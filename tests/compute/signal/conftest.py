"""A machine without Hypothesis (one lent for its GPU, say) still runs the CUDA tests."""

from importlib.util import find_spec

collect_ignore = [] if find_spec("hypothesis") else ["test_signal_finder.py"]
