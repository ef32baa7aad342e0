"""Scenes whose kernels run in numba's CUDA simulator: SCENE... -> the kernels that ran, and the last positions of each.

The kernels are those of a GPU, one thread an index, with blocks that are not full; only the arrays are pretended.
"""

import os
import sys
from unittest.mock import patch

os.environ |= {
    "NUMBA_ENABLE_CUDASIM": "1",
    "NUMBA_DISABLE_JIT": "1",
}  # the simulator reads Python, not what is compiled
from block_scene import play
from pretend_gpu import bare, module, pretended

with module("cupy"):
    from msmpetsc.backend import launcher as launching

ran = set()


def launcher(body):
    ran.add(body.__name__)
    return launching.launcher(body)


replaced = {"as_argument": lambda value: (None, bare(value)), "_stream": lambda: 0, "THREADS": 8}
with patch.multiple(launching, **replaced), pretended(launcher):
    last = [play(scene)[1][-1].position for scene in sys.argv[1:]]
print(*sorted(ran))
for position in last:
    print(*map(float.hex, position.ravel().tolist()))
