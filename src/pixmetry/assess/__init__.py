"""A camera measured blind from its frames: every source, the budget, advice, the report; and frames corrected with it.

A campaign enters; a result folder with estimates, budget, digital twin and page leaves.
"""
