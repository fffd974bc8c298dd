# SPDX-License-Identifier: Apache-2.0
"""A bag is published as if it were live: player, its clock, its peers, its keyboard."""
