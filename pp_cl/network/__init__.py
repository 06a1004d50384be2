"""The U-Net and the buffers it shares."""
