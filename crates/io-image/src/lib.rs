//! Image files in and out: PNG, JPEG, TIFF, EXR, NPY
