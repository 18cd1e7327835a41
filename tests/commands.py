"""Commands that several test modules give."""

import numpy as np

from bipedtrack.nodes import NodeRates, Nodes
from bipedtrack.planner import Command


def still(target: Nodes) -> Command:
    """To stand still on a target."""
    return Command(target, target, NodeRates(*(np.zeros(shape) for shape in ((3,), (3,), (2, 3), (2,)))), np.zeros(2))
