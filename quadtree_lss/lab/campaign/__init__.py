# SPDX-License-Identifier: Apache-2.0
"""Studies of many flights, flown on one computer or many."""
