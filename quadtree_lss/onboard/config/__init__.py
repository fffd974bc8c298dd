# SPDX-License-Identifier: Apache-2.0
"""One declaration per parameter; reading configurations; the document of all parameters."""
