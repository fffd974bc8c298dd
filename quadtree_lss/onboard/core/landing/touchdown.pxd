# Known when it is compiled: loops of so many steps take several at a time.
cdef enum:
    #: Side of the blocks of grid points that are judged together.
    BLOCK = 8
    #: Heights that are told apart in the order of the cells.
    BINS = 32
    #: Higher than any ground over a plane near it, m.
    FAR = 1000000000
