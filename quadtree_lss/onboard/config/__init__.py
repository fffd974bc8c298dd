# SPDX-License-Identifier: Apache-2.0
"""Parameters, configuration files and the risk model."""
