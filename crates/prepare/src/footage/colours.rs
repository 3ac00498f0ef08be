//! Colours of films: their tags, and the filters of ffmpeg between a film's colours and RGB.
//!
//! A film stores luma and two differences of colour, `Y = k_r R + k_g G + k_b B`. The matrix tag names the
//! weights. The range tag says if black and white are 16 and 235 (`tv`) or 0 and 255 (`pc`). Both conversions
//! use the film's own matrix and range, so a frame that is read and written unchanged stays the same up to
//! rounding, compression and its halved colour resolution. Primaries and transfer are not converted: RGB
//! values are the film's own.
//!
//! ffmpeg 9 writes full range with colour differences that are half a level too small, about one level of red
//! and blue; ffmpeg 5 does not.
//!
//! A film that names no matrix has BT.709 from 720 lines on, and else BT.601, as players assume.

/// The colour tags of a film, in the words of ffmpeg; `None` for what it does not name.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct ColourTags {
    /// `tv` for limited range, `pc` for full range.
    pub range: Option<String>,
    /// The matrix between RGB and luma, such as `bt709`.
    pub matrix: Option<String>,
    /// The primaries, such as `bt709`.
    pub primaries: Option<String>,
    /// The transfer function, such as `bt709`.
    pub transfer: Option<String>,
}

/// The smallest number of lines of a film that has BT.709 if it names no matrix.
const HIGH_DEFINITION: usize = 720;
/// The scaler's way to resample colours and to round.
const EXACT: &str = "flags=bicubic+accurate_rnd+full_chroma_int+full_chroma_inp";

impl ColourTags {
    /// True if the film's colours are for HDR screens.
    pub fn is_hdr(&self) -> bool {
        self.transfer.as_deref().is_some_and(|t| ["smpte2084", "arib-std-b67"].contains(&t))
    }

    /// The matrix that is used for a film of this height, in the words of the scaler.
    fn scaler_matrix(&self, height: usize) -> &'static str {
        match self.matrix.as_deref() {
            Some("bt709") => "bt709",
            Some("bt470bg" | "smpte170m" | "bt601") => "bt601",
            Some("fcc") => "fcc",
            Some("smpte240m") => "smpte240m",
            Some("bt2020nc" | "bt2020c" | "bt2020ncl" | "bt2020cl") => "bt2020",
            _ if height >= HIGH_DEFINITION => "bt709",
            _ => "bt601",
        }
    }

    fn scaler_range(&self) -> &'static str {
        if self.range.as_deref() == Some("pc") { "pc" } else { "tv" }
    }

    /// The filter from the film's colours to RGB. Films that are stored as RGB pass it unchanged.
    pub(super) fn film_to_rgb(&self, height: usize) -> String {
        let (matrix, range) = (self.scaler_matrix(height), self.scaler_range());
        format!("scale=in_color_matrix={matrix}:in_range={range}:{EXACT},format=rgb24")
    }

    /// The tags of a film that is written with the matrix of this one. One stored as RGB gets the matrix that
    /// it is converted with.
    pub(super) fn written(&self, height: usize) -> Self {
        let rgb = self.matrix.as_deref() == Some("gbr");
        let matrix = if rgb && self.scaler_matrix(height) == "bt601" {
            "smpte170m"
        } else {
            self.scaler_matrix(height)
        };
        match rgb {
            true => Self { matrix: Some(matrix.into()), range: Some("tv".into()), ..self.clone() },
            false => self.clone(),
        }
    }

    /// The filter from RGB to the film's colours with this pixel format, and its tags on every frame.
    pub(super) fn rgb_to_film(&self, height: usize, format: &str) -> String {
        let (matrix, range) = (self.scaler_matrix(height), self.scaler_range());
        let or_unknown = |tag: &Option<String>| tag.clone().unwrap_or_else(|| "unknown".into());
        format!(
            "scale=out_color_matrix={matrix}:out_range={range}:{EXACT},format={format},\
             setparams=range={}:colorspace={}:color_primaries={}:color_trc={}",
            or_unknown(&self.range),
            or_unknown(&self.matrix),
            or_unknown(&self.primaries),
            or_unknown(&self.transfer),
        )
    }

    /// The arguments that tag an encoded film.
    pub(super) fn arguments(&self) -> Vec<String> {
        let all = [
            ("-color_range", &self.range),
            ("-colorspace", &self.matrix),
            ("-color_primaries", &self.primaries),
            ("-color_trc", &self.transfer),
        ];
        let named = all.into_iter().filter_map(|(flag, tag)| Some([flag.to_string(), tag.clone()?]));
        named.flatten().collect()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn matrix_and_range_come_from_the_tags_and_else_from_the_height() {
        let tagged = |matrix: &str, range: &str| ColourTags {
            matrix: Some(matrix.into()),
            range: Some(range.into()),
            ..ColourTags::default()
        };
        for (tags, height, matrix, range) in [
            (ColourTags::default(), 720, "bt709", "tv"),
            (ColourTags::default(), 719, "bt601", "tv"),
            (tagged("smpte170m", "pc"), 1080, "bt601", "pc"),
            (tagged("bt2020nc", "tv"), 2160, "bt2020", "tv"),
        ] {
            let filter = tags.film_to_rgb(height);
            assert!(filter.contains(&format!("in_color_matrix={matrix}:in_range={range}:")), "{filter}");
        }
        let tags = tagged("bt709", "pc");
        assert_eq!(tags.arguments(), ["-color_range", "pc", "-colorspace", "bt709"]);
        assert!(
            tags.rgb_to_film(480, "yuv420p")
                .ends_with("colorspace=bt709:color_primaries=unknown:color_trc=unknown")
        );
        assert_eq!(tagged("gbr", "pc").written(480), tagged("smpte170m", "tv"));
        assert_eq!(ColourTags::default().written(480), ColourTags::default());
    }
}
