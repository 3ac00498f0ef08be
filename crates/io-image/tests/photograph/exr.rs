//! EXR: floats and half floats stay, and so do attributes, further channels and layers.

use std::io::Cursor;

use exr::image::FlatImage;
use exr::prelude::*;
use use3d_io_image::{FileFormat, Photograph, Rgb, photograph_info};

use crate::fixtures::{HISTORY, SOFTWARE};
use crate::inverted;

/// An EXR with the colours as half or full floats, alpha, a depth, a second layer, and attributes.
pub(crate) fn exr(half: bool) -> Vec<u8> {
    let size = Vec2(6, 5);
    let plane = |k: usize| -> Vec<f32> { (0..30).map(|i| (i + 10 * k) as f32 / 64.0).collect() };
    let channel = |name: &str, k: usize| {
        let samples = if half && name != "Z" {
            FlatSamples::F16(plane(k).into_iter().map(f16::from_f32).collect())
        } else {
            FlatSamples::F32(plane(k))
        };
        AnyChannel::new(name, samples)
    };
    let colors = ["R", "G", "B", "A", "Z"].iter().enumerate().map(|(k, name)| channel(name, k)).collect();
    let mut attributes = LayerAttributes::named("picture");
    attributes.owner = Some(Text::from("A. Diver"));
    attributes.exposure = Some(0.008);
    attributes.software_name = Some(Text::from("Darkroom 2"));
    attributes.other.insert(Text::from("dive"), AttributeValue::I32(17));
    let first = Layer::new(size, attributes, Encoding::SMALL_LOSSLESS, AnyChannels::sort(colors));
    let mask = AnyChannels::sort([channel("Y", 9)].into_iter().collect());
    let second = Layer::new(size, LayerAttributes::named("mask"), Encoding::FAST_LOSSLESS, mask);
    let bounds = IntegerBounds::new((0, 0), size);
    let mut image: FlatImage =
        Image::from_layers(ImageAttributes::new(bounds), [first, second].into_iter().collect::<Layers<_>>());
    image.attributes.pixel_aspect = 1.5;
    let mut bytes = Cursor::new(Vec::new());
    image.write().non_parallel().to_buffered(&mut bytes).unwrap();
    bytes.into_inner()
}

#[test]
fn attributes_channels_and_layers_are_kept() {
    for half in [false, true] {
        let original = exr(half);
        let (photograph, written) = inverted(&original, "a.exr");
        assert_eq!((photograph.format, photograph.orientation()), (FileFormat::Exr, 1));
        let Rgb::Float(pixels) = &photograph.pixels else { panic!("floats") };
        assert_eq!(pixels[..4], [0.0, 10.0 / 64.0, 20.0 / 64.0, 1.0 / 64.0]);
        let layers = |bytes: &[u8]| {
            let reader = read().no_deep_data().largest_resolution_level().all_channels().all_layers();
            reader.all_attributes().non_parallel().from_buffered(Cursor::new(bytes.to_vec())).unwrap()
        };
        let (old, new) = (layers(&original), layers(&written));
        assert_eq!(old.attributes, new.attributes);
        assert_eq!(old.layer_data[1], new.layer_data[1]);
        let (a, b) = (&old.layer_data[0], &new.layer_data[0]);
        assert_eq!((a.encoding, a.size), (b.encoding, b.size));
        for (a, b) in a.channel_data.list.iter().zip(&b.channel_data.list) {
            assert_eq!(a.name, b.name);
            let same_type = std::mem::discriminant(&a.sample_data) == std::mem::discriminant(&b.sample_data);
            assert!(same_type);
            if ["A", "Z"].iter().any(|n| a.name.eq(n)) {
                assert_eq!(a.sample_data, b.sample_data);
            }
        }
        let mut attributes = b.attributes.clone();
        assert_eq!(attributes.software_name.take(), Some(Text::from(SOFTWARE)));
        let history = attributes.other.remove(&Text::from("history"));
        let expected = format!("{HISTORY} (Software before: Darkroom 2)");
        assert_eq!(history, Some(AttributeValue::Text(Text::from(expected.as_str()))));
        attributes.software_name = a.attributes.software_name.clone();
        assert_eq!(attributes, a.attributes);
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("a.exr");
        std::fs::write(&path, &written).unwrap();
        let info = photograph_info(&path).unwrap();
        assert_eq!((info.bits, info.alpha, info.orientation), (if half { 16 } else { 32 }, true, 1));
    }
}

#[test]
fn an_exr_without_colours_is_no_photograph() {
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("z.exr");
    use3d_io_image::write_exr_channels(&path, 2, 1, &[("Z", &[1.0, 2.0])]).unwrap();
    let said = Photograph::read(&path).unwrap_err().to_string();
    assert!(said.contains("z.exr") && said.contains("R G B") && said.contains("channels Z"), "{said}");
}
