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

/// A colour space other than sRGB.
pub(crate) struct ColorSpace {
    /// Its name, as the file has it.
    name: String,
    profile: Box<ColorProfile>,
}

/// The profile, or the gamma, that a file states.
enum Stated {
    Profile(Vec<u8>),
    Gamma(f32),
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
                _ => None,
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
    /// The colour space that a file states; `None` if it is sRGB, or cannot be used.
    fn of(reader: &mut dyn ByteSource, format: FileFormat) -> Option<Self> {
        let (profile, name) = match stated(reader, format)? {
            Stated::Profile(bytes) => {
                let profile = ColorProfile::new_from_slice(&bytes).ok()?;
                let name = name_of(&profile);
                (profile, name)
            }
            Stated::Gamma(gamma) => {
                if !(0.1..=2.0).contains(&gamma) || (gamma - USUAL_GAMMA.0).abs() < USUAL_GAMMA.1 {
                    return None;
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
        space.apply(&mut converted, Layout::Rgb).ok()?;
        let Samples::Eight(converted) = converted else { return None };
        colors.iter().zip(&converted).any(|(a, b)| a.abs_diff(*b) > SAME).then_some(space)
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
    let space = ColorSpace::of(&mut Cursor::new(bytes), format)?;
    space.apply(&mut decoded.samples, layout).ok()?;
    Some(space.name)
}

/// The name of the colour space that a file states; `None` if it is sRGB, or cannot be used.
pub(crate) fn name(reader: &mut dyn ByteSource, format: FileFormat) -> Option<String> {
    ColorSpace::of(reader, format).map(|space| space.name)
}
