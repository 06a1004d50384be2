"""The operations of the network: convolutions in variants, pooling, upsampling, gates, tiles."""
