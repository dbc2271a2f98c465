"""The paper's tables, measured again: keyframes, depth error by gap, ablations, end to end.

``published`` holds the paper's figures. ``gaps``, ``keyframes`` and ``end_to_end`` each measure one recorded
sequence at a time; ``schedules`` are triggers made afterwards. ``figures`` turns sequences into means with
intervals, the ``..._tables`` write them beside the paper's, and ``targets`` checks what has to be reached.
``job`` ties one table together, from the recordings of ``data`` to a ``document``.
"""
