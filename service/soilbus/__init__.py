import os

# Our matrices are too small to be shared out among threads: waiting for each other they would take 1.7 times the
# processor time, and more wall time.  Numpy reads this when it is loaded, here or in a process that we start.
os.environ.setdefault("OMP_NUM_THREADS", "1")
