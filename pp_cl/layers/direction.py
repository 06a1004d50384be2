"""The three computations of a convolution in a training step."""

from enum import Enum


class Direction(Enum):
    """What is computed. The values are the words in stored tunings and in bench rows."""

    FORWARD = "forward"
    BACKWARD_INPUT = "input"  # gradient of the input
    BACKWARD_WEIGHTS = "weights"  # gradients of weights and bias
