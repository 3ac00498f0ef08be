//! Image quality and consistency formulas: PSNR, SSIM, MS-SSIM, UCIQE, UIQM, CIEDE2000, warping
pub mod ms_ssim;
