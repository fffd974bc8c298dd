# SPDX-License-Identifier: Apache-2.0
"""What a person looks at first: the page and its figures."""
