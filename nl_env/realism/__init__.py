"""How close the synthetic scenes come to ELiDAR: the figures of the paper and of the released checkpoint.

Each world yields prior/truth pairs at the paper's five gaps (``world``). From them come the Repeat row by
gap, the share of valid pixels whose prior is sky, the change of depth and the active event pixels with
speed, and, with the authors' checkpoint (``network``), its error and what arrives at its batch norms.
``summary`` averages over worlds, ``tables`` and ``plots`` show the result beside what is ``published``.
"""
