# SPDX-License-Identifier: Apache-2.0
"""A touchdown with legs, by a physics engine (extra ``physics``)."""
