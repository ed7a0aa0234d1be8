"""C of a policy: fixed-point network and its proof, constant arrays, runtime, checks."""
