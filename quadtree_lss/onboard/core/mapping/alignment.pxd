# SPDX-License-Identifier: Apache-2.0
from libc.math cimport INFINITY, exp, fabs, sqrt
from quadtree_lss.onboard.core.tree.leaves cimport HINTS, Leaf, LeafTable

cpdef lift(LeafTable table, double height, double since)
