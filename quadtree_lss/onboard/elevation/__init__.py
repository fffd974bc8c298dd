# SPDX-License-Identifier: Apache-2.0
"""Elevation models and their places, read from files; the libraries that takes are optional."""
