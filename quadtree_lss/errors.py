# SPDX-License-Identifier: Apache-2.0
"""The exception every error meant for a user derives from."""


class QuadtreeLssError(Exception):
    """Something the user can mend; its text is one clear line."""
