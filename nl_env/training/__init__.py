"""Training: one loop for every network, resumable to the bit.

A :class:`Task` says what a batch, the loss and the validation are; :func:`train` does the rest. All that
is random at a step follows from the seed and the step's number, so a run that was killed and resumed ends
with the same weights as one that was not (on one machine, with the same number of threads).
"""

from nl_env.training.loop import TrainingResult, train
from nl_env.training.options import TrainingOptions, seeded
from nl_env.training.task import Forward, Task

__all__ = ["Forward", "Task", "TrainingOptions", "TrainingResult", "seeded", "train"]
