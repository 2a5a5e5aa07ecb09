"""``flexroad train``: train the head of `segment: dinov2` on tiles of a catalog, and validate it on others.

For users with labelled tiles and without road vectors. Start at `driver.train`, which separates tiles of
training and validation; `fit_head.py` trains.
"""
