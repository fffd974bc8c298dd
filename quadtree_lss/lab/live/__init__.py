# SPDX-License-Identifier: Apache-2.0
"""Whole systems over DDS: both nodes as processes, a flight by them, the demo."""
