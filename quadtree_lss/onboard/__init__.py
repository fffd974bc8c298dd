# SPDX-License-Identifier: Apache-2.0
"""What flies: configuration, core, messages and the nodes. Knows neither desk nor lab."""
