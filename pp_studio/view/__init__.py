"""The viewer of `pp-cl view`: a run in the browser, also while it trains, or a scene."""
