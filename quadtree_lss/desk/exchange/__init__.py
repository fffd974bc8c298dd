# SPDX-License-Identifier: Apache-2.0
"""Reading of elevation models and results folders."""
