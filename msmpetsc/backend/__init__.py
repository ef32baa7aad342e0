"""Arrays and kernels on a CPU (NumPy) or on a CUDA GPU (CuPy).

The type of a run's arrays selects the device, so most code is the same for both. NumPy's functions
dispatch CuPy's arrays to CuPy, and ``kernel`` compiles a function for either device. A few sums
have a loop for each device.
"""
