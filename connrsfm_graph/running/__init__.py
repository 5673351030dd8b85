"""How a long run is carried out: in blocks of images, by processes or a cluster, within a memory limit, resumable.

None of this changes a result: the same tracks and settings give the same arrays, bit by bit, whoever works on them, in
blocks of any size, and however often the run was interrupted and resumed.
"""
