# SPDX-License-Identifier: Apache-2.0
"""Campaigns: studies of many simulated flights on one or several computers."""
