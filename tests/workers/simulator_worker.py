"""Run scenes by kernels in numba's CUDA simulator: SCENE... -> kernels that ran, last positions.

The kernels are a GPU's, a thread per index, with blocks that are not full. Only the arrays are
pretended.
"""

import os
import sys

# the simulator interprets Python instead of compiled code
os.environ |= {
    "NUMBA_ENABLE_CUDASIM": "1",
    "NUMBA_DISABLE_JIT": "1",
}
from block_scene import play
from numba import cuda
from pretend_gpu import bare, module, pretended

with module("cupy"):
    from msmpetsc.backend import launcher as launching

ran = set()
THREADS = 8


def launcher(body):
    ran.add(body.__name__)
    kernel = cuda.jit(launching.kernel_of(body))

    def launch(count, *arguments):
        if count:
            kernel[-(-count // THREADS), THREADS](count, tuple(map(bare, arguments)))

    return launch


with pretended(launcher):
    last = [play(scene)[1][-1].position for scene in sys.argv[1:]]
print(*sorted(ran))
for position in last:
    print(*map(float.hex, position.ravel().tolist()))
