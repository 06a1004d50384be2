"""Image metrics (PSNR, SSIM, LPIPS) and the completeness of points against a mesh."""
