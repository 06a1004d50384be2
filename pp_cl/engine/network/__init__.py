"""The U-Net: its layers, its memory, its forward and backward pass, and how it skips background."""
