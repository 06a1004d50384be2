"""The network's operations: convolutions in variants, pooling, upsampling, gates, tiles."""
