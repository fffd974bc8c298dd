# SPDX-License-Identifier: Apache-2.0
"""Scoring of results against simulated truth."""
