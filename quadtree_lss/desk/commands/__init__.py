# SPDX-License-Identifier: Apache-2.0
"""Subcommands of ``quadtree-lss``: options in, a call of an importable function, text out."""
