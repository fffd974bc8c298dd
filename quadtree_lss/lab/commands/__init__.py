# SPDX-License-Identifier: Apache-2.0
"""Commands of the lab: simulate, evaluate, fly, campaign, fit-risk."""
