# SPDX-License-Identifier: Apache-2.0
"""Evaluation of results against simulated truth, and the fit of the risk model."""
