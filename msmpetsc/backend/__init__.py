"""Where the arrays of a run are: NumPy's, in the memory of the CPU, or CuPy's, in that of a CUDA GPU.

The arrays' type decides, and code that works on them does not ask: NumPy's functions hand CuPy's arrays to CuPy,
``kernel`` compiles a body for either, and the few sums that a loop on the CPU does best have a form for each.
"""
