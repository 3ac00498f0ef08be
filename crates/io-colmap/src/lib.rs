//! COLMAP models and capture folders in and out: undistortion, splits, pose normalisation, masks, depth priors
