"""Convolutions and resampling: the network's operations, in variants."""
