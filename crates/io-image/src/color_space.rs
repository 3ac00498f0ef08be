//! The colour space that a photograph's file states, and the conversion of its colours to sRGB.
//!
//! A file states it by an ICC profile (JPEG, PNG, TIFF) or by the gamma of a PNG (`gAMA`). Colours without a
//! statement are sRGB, and so are those of a profile that gives every colour nearly the same value. Then no
//! byte changes.
//!
//! Limits: profiles for grey and CMYK, and the words of EXIF data and `cICP`, are not used. The library's
//! last bits may differ between processors.

use std::io::{Cursor, Read};

use moxcms::{CmsError, ColorProfile, DataColorSpace, Layout, ProfileText, ToneReprCurve, TransformOptions};

use crate::byte_source::ByteSource;
use crate::decoded::{Decoded, Samples};
use crate::error::FileFormat;
use crate::jpeg;

/// Bytes at the beginning of a JPEG that may hold its profile.
const HEAD: u64 = 1 << 20;
/// The largest profile that is unpacked, bytes.
const LARGEST: usize = 4 << 20;
/// The gamma of sRGB files, and the difference from it that counts.
const USUAL_GAMMA: (f32, f32) = (0.454_55, 0.03);
/// A profile whose colours differ by at most this many steps of 255 is that of sRGB.
const SAME: u8 = 2;

/// The use of what a file states about its colours.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub enum ColorUse {
    /// The colours are sRGB.
    #[default]
    Srgb,
    /// The colours are converted to sRGB when they are read, from the space of this name.
    Converted(String),
    /// The statement cannot be used, and the colours are used as stored: its profile is damaged, or not one
    /// for red, green and blue.
    AsStored,
}

/// A colour space other than sRGB.
pub(crate) struct ColorSpace {
    /// Its name, as the file has it.
    name: String,
    profile: Box<ColorProfile>,
}

/// The profile, or the gamma, that a file states; or a name that changes no byte here.
enum Stated {
    Profile(Vec<u8>),
    Gamma(f32),
    Named,
}

fn stated(reader: &mut dyn ByteSource, format: FileFormat) -> Option<Stated> {
    match format {
        FileFormat::Jpeg => {
            let mut head = Vec::new();
            reader.take(HEAD).read_to_end(&mut head).ok()?;
            jpeg::profile(&head).map(Stated::Profile)
        }
        FileFormat::Png => {
            let decoder = png::Decoder::new_with_limits(reader, png::Limits { bytes: LARGEST });
            let reader = decoder.read_info().ok()?;
            let info = reader.info();
            match (&info.icc_profile, info.srgb, info.gama_chunk) {
                (Some(profile), ..) => Some(Stated::Profile(profile.to_vec())),
                (None, None, Some(gamma)) => Some(Stated::Gamma(gamma.into_value())),
                (None, srgb, None) if srgb.is_none() && info.coding_independent_code_points.is_none() => None,
                _ => Some(Stated::Named),
            }
        }
        FileFormat::Tiff => {
            let mut decoder = tiff::decoder::Decoder::new(reader).ok()?;
            decoder.get_tag_u8_vec(tiff::tags::Tag::IccProfile).ok().map(Stated::Profile)
        }
        FileFormat::Exr | FileFormat::Npy => None,
    }
}

fn name_of(profile: &ColorProfile) -> String {
    let text = match &profile.description {
        Some(ProfileText::PlainString(text)) => Some(text.clone()),
        Some(ProfileText::Localizable(texts)) => texts.first().map(|text| text.value.clone()),
        Some(ProfileText::Description(text)) => Some(text.ascii_string.clone()),
        None => None,
    };
    let text = text.map(|text| text.trim_matches(['\0', ' ']).to_string());
    text.filter(|text| !text.is_empty()).unwrap_or_else(|| "a colour space of its own".into())
}

impl ColorSpace {
    /// The colour space that a file states; `None` if it is sRGB.
    fn of(reader: &mut dyn ByteSource, format: FileFormat) -> Result<Option<Self>, CmsError> {
        let (profile, name) = match stated(reader, format) {
            None | Some(Stated::Named) => return Ok(None),
            Some(Stated::Profile(bytes)) => {
                let profile = ColorProfile::new_from_slice(&bytes)?;
                let name = name_of(&profile);
                (profile, name)
            }
            Some(Stated::Gamma(gamma)) => {
                if (gamma - USUAL_GAMMA.0).abs() < USUAL_GAMMA.1 {
                    return Ok(None);
                }
                if !(0.1..=2.0).contains(&gamma) {
                    return Err(CmsError::InvalidProfile);
                }
                let mut profile = ColorProfile::new_srgb();
                // A table of one entry is an exponent, in steps of 256.
                let curve = Some(ToneReprCurve::Lut(vec![(256.0 / gamma).round() as u16]));
                (profile.red_trc, profile.green_trc, profile.blue_trc) =
                    (curve.clone(), curve.clone(), curve);
                profile.cicp = None;
                let name = if gamma == 1.0 { "linear light".into() } else { format!("gamma {gamma:.2}") };
                (profile, name)
            }
        };
        let space = Self { name, profile: Box::new(profile) };
        let steps = || (0..=4u8).map(|step| step.saturating_mul(64));
        let colors: Vec<u8> =
            steps().flat_map(|r| steps().flat_map(move |g| steps().flat_map(move |b| [r, g, b]))).collect();
        let mut converted = Samples::Eight(colors.clone());
        space.apply(&mut converted, Layout::Rgb)?;
        let Samples::Eight(converted) = converted else { return Ok(None) };
        let differs = colors.iter().zip(&converted).any(|(a, b)| a.abs_diff(*b) > SAME);
        Ok(differs.then_some(space))
    }

    fn apply(&self, samples: &mut Samples, layout: Layout) -> Result<(), CmsError> {
        if self.profile.color_space != DataColorSpace::Rgb {
            return Err(CmsError::InvalidProfile);
        }
        let (srgb, options) = (ColorProfile::new_srgb(), TransformOptions::default());
        match samples {
            Samples::Eight(values) => {
                let transform = self.profile.create_transform_8bit(layout, &srgb, layout, options)?;
                transform.transform(&values.clone(), values)
            }
            Samples::Sixteen(values) => {
                let transform = self.profile.create_transform_16bit(layout, &srgb, layout, options)?;
                transform.transform(&values.clone(), values)
            }
            Samples::Float(values) => {
                let transform = self.profile.create_transform_f32(layout, &srgb, layout, options)?;
                transform.transform(&values.clone(), values)
            }
        }
    }
}

/// Converts the colours of a decoded file to sRGB; returns the name of the colour space that they had, or
/// `None` if nothing changed.
pub(crate) fn convert(bytes: &[u8], format: FileFormat, decoded: &mut Decoded) -> Option<String> {
    let layout = match decoded.channels {
        3 => Layout::Rgb,
        4 => Layout::Rgba,
        _ => return None,
    };
    let space = ColorSpace::of(&mut Cursor::new(bytes), format).ok()??;
    space.apply(&mut decoded.samples, layout).ok()?;
    Some(space.name)
}

/// True if a file states what its colours stand for, also if they are sRGB.
pub(crate) fn states_any(reader: &mut dyn ByteSource, format: FileFormat) -> bool {
    stated(reader, format).is_some()
}

/// The use of what a file states about its colours.
pub(crate) fn color_use(reader: &mut dyn ByteSource, format: FileFormat) -> ColorUse {
    match ColorSpace::of(reader, format) {
        Ok(None) => ColorUse::Srgb,
        Ok(Some(space)) => ColorUse::Converted(space.name),
        Err(_) => ColorUse::AsStored,
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use image::ImageEncoder;

    fn png_with(profile: Vec<u8>) -> Vec<u8> {
        let mut bytes = Vec::new();
        let mut encoder = image::codecs::png::PngEncoder::new(&mut bytes);
        encoder.set_icc_profile(profile).unwrap();
        encoder.write_image(&[10, 90, 200, 40, 40, 40], 2, 1, image::ExtendedColorType::Rgb8).unwrap();
        bytes
    }

    fn used(profile: Vec<u8>) -> ColorUse {
        color_use(&mut Cursor::new(png_with(profile)), FileFormat::Png)
    }

    #[test]
    fn a_profile_is_used_or_said_to_be_of_no_use() {
        let encoded = |profile: ColorProfile| profile.encode().unwrap();
        assert_eq!(used(encoded(ColorProfile::new_srgb())), ColorUse::Srgb);
        assert!(matches!(used(encoded(ColorProfile::new_adobe_rgb())), ColorUse::Converted(_)));
        assert_eq!(used(encoded(ColorProfile::new_gray_with_gamma(2.2))), ColorUse::AsStored);
        assert_eq!(used(b"no profile".to_vec()), ColorUse::AsStored);
    }

    #[test]
    fn a_statement_counts_also_if_it_changes_nothing() {
        let srgb = ColorProfile::new_srgb().encode().unwrap();
        let states = |bytes: Vec<u8>, format| states_any(&mut Cursor::new(bytes), format);
        let tiff = |profile: Option<&[u8]>| {
            let mut bytes = Cursor::new(Vec::new());
            let mut encoder = tiff::encoder::TiffEncoder::new(&mut bytes).unwrap();
            let mut image = encoder.new_image::<tiff::encoder::colortype::RGB16>(1, 1).unwrap();
            if let Some(profile) = profile {
                image.encoder().write_tag(tiff::tags::Tag::IccProfile, profile).unwrap();
            }
            image.write_data(&[1, 2, 3]).unwrap();
            bytes.into_inner()
        };
        assert!(states(png_with(srgb.clone()), FileFormat::Png));
        assert!(states(tiff(Some(&srgb)), FileFormat::Tiff) && !states(tiff(None), FileFormat::Tiff));
    }

    #[test]
    fn mutated_profiles_never_panic() {
        let whole = ColorProfile::new_adobe_rgb().encode().unwrap();
        for round in 0..300 {
            let bytes = png_with(use3d_golden::mutated(&whole, b"\0\xffXYZ", round));
            let mut decoded = crate::read::decode(&bytes, std::path::Path::new("mutated")).unwrap();
            convert(&bytes, FileFormat::Png, &mut decoded);
            assert_eq!((decoded.width, decoded.height, decoded.channels), (2, 1, 3));
        }
    }
}
