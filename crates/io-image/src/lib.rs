//! Reads and writes image files. It does not resize or correct pictures, except the small JPEGs for pages.
//!
//! Formats for reading: PNG (1 to 16 bits), JPEG, TIFF (8, 16 bits, float), EXR (half, float), NPY. Formats
//! for writing: PNG (8, 16 bits), EXR (float), and JPEGs for pages. Formats are recognised by their first
//! bytes, not by the name. Values are display-referred (a PNG value over 255) and never linearised; EXR files
//! hold the same values unclamped. Colours of a file that states another space than sRGB are converted to it.
//!
//! [`Photograph`] reads a photograph with all of its metadata and writes new pixels into a file of the same
//! format (JPEG, PNG, TIFF, EXR).
//!
//! [`read_exif`] reads orientation, camera and GPS position of a JPEG.
//!
//! Every size is checked before memory is allocated (at most [`MAX_PIXELS`], and never more than the file's
//! own length can hold). Every file is written under a temporary name in the same folder and then renamed, so
//! it is written completely or not at all.
//!
//! ```no_run
//! # fn main() -> Result<(), use3d_io_image::ImageError> {
//! use std::path::Path;
//! let image = use3d_io_image::read_image(Path::new("reef.jpg"))?;
//! use3d_io_image::write_exr(Path::new("reef.exr"), &image)?;
//! # Ok(())
//! # }
//! ```

mod byte_source;
mod color_space;
mod cut_off;
mod decoded;
mod embed;
mod error;
mod exif;
mod exr_file;
mod folder;
mod histogram;
mod jpeg;
mod limits;
mod npy;
mod photograph;
mod png_file;
mod read;
mod tiff_structure;
mod write;

pub use color_space::ColorUse;
pub use cut_off::is_cut_off;
pub use decoded::{Decoded, Samples};
pub use embed::{JpegError, jpeg_address, shrunk};
pub use error::{FileFormat, ImageError};
pub use exif::{Exif, GpsPosition, exif_of_bytes, read_exif, straighten};
pub use exr_file::{write_exr, write_exr_channels, write_exr_map};
pub use folder::{FolderError, images_by_stem};
pub use histogram::ChannelHistogram;
pub use limits::MAX_PIXELS;
pub use photograph::{
    Photograph, PhotographInfo, Rgb, photograph_info, states_colors, whole_photograph_info,
};
pub use read::{
    ImageInfo, decode, image_info, image_size, info_of_bytes, read, read_image, read_map, read_pixels,
    read_pixels_with_alpha,
};
pub use write::{write_png, write_png_map, write_png_map16, write_png_pixels, write_png8, write_png16};
