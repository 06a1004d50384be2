"""The U-Net: its layers, memory, forward and backward pass, and how it skips background."""
