"""The half of PyPI's `edt` of `flockmap-bench field`.

Argument: a file with a box, little-endian: u32 x y z, then two times u8 for each voxel (1 is an obstacle; x fastest):
the box before and after a scan. Standard input: "anew" times a field of the box after the scan; "write PATH" writes its
squared distances as f32. Standard output: for each line, milliseconds.
"""

import sys
import time

import edt
import numpy as np

data = np.fromfile(sys.argv[1], np.uint8)
size = data[:12].view("<u4")
after = data[12:].reshape(2, -1)[1]
# What is not zero gets its distance to what is. Fortran order is the one in which x is the fastest.
free = (after == 0).reshape(size, order="F")
for line in sys.stdin:
    words = line.split()
    start = time.perf_counter()
    squared = edt.edtsq(free, black_border=False, parallel=1)
    milliseconds = (time.perf_counter() - start) * 1e3
    if words[0] == "write":
        squared.astype("<f4").ravel(order="F").tofile(words[1])
    print(milliseconds, flush=True)
