//! The captures with known truth, by name.
//!
//! Five follow the method's own formation in waters from clear ocean to turbid coast, a sixth in a tiled
//! pool, a seventh in a pool whose tiles have the colour of open water. Three follow physics that differ from
//! the method's (wavelengths in linear light, a camera that exposes and balances every view on its own):
//! daylight, lamps, air; a fourth is air against the light. Three more are taken with a camera that develops
//! as action cameras do, with reef spectra and grey boards near and far. None has depth priors, since those
//! of synthetic captures are made from the true depth.

use use3d_synth::{CaptureParams, Development, Location, Physics, WaterType};

use use3d_pipeline::WorkError;

/// The description of a synthetic capture.
#[derive(Clone, Copy, Debug)]
pub struct Capture {
    /// Its name in tables, in scenes and in `--captures`.
    pub name: &'static str,
    /// A description for readers of the table.
    pub about: &'static str,
    /// Water type; `None` for air.
    water: Option<WaterType>,
    physics: Physics,
    place: Location,
    /// Light of the lamps, see [`CaptureParams::lamps`].
    lamps: f32,
    /// The camera's development; with [`Development::Action`] the scene contains boards of greys.
    camera: Development,
    /// See [`CaptureParams::backlight`].
    backlight: f32,
}

const fn display(name: &'static str, about: &'static str, water: WaterType) -> Capture {
    Capture {
        name,
        about,
        water: Some(water),
        physics: Physics::Display,
        place: Location::Reef,
        lamps: 0.0,
        camera: Development::Plain,
        backlight: 0.0,
    }
}

const fn spectral(name: &'static str, about: &'static str, water: Option<WaterType>, lamps: f32) -> Capture {
    let plain = display(name, about, WaterType::Ii);
    Capture { water, physics: Physics::Spectral, lamps, ..plain }
}

const fn action(name: &'static str, about: &'static str, water: WaterType) -> Capture {
    Capture { camera: Development::Action, ..spectral(name, about, Some(water), 0.0) }
}

/// All captures.
pub const CAPTURES: [Capture; 14] = [
    display("display-I", "The method's own formation, clear ocean (Jerlov I)", WaterType::I),
    display("display-II", "The method's own formation, ocean (Jerlov II)", WaterType::Ii),
    display("display-III", "The method's own formation, dull ocean (Jerlov III)", WaterType::Iii),
    display("display-1C", "The method's own formation, clear coast (Jerlov 1C)", WaterType::Coastal1),
    display("display-5C", "The method's own formation, turbid coast (Jerlov 5C)", WaterType::Coastal5),
    Capture {
        place: Location::Pool,
        ..display("pool", "The method's own formation, a tiled pool (Jerlov IB)", WaterType::Ib)
    },
    spectral(
        "spectral",
        "Ten wavelengths in linear light, ocean (Jerlov II), every view exposed and balanced on its own",
        Some(WaterType::Ii),
        0.0,
    ),
    spectral("lamps", "The same with two lamps at the camera", Some(WaterType::Ii), 3.0),
    spectral("air", "The same without water and lamps", None, 0.0),
    Capture {
        place: Location::VeilPool,
        ..display("veil-pool", "The pool with tiles of the colour of open water", WaterType::Ib)
    },
    Capture {
        backlight: 1.0,
        ..spectral("air-backlit", "Air, taken against the light of the sky", None, 0.0)
    },
    action(
        "camera-I",
        "An action camera on a reef in clear ocean (Jerlov I), with grey boards",
        WaterType::I,
    ),
    action("camera-II", "The same in ocean (Jerlov II)", WaterType::Ii),
    action("camera-1C", "The same at a clear coast (Jerlov 1C)", WaterType::Coastal1),
];

/// The captures of these names, in the order of [`CAPTURES`]; upper and lower case are not distinguished. All
/// captures if the list is empty.
///
/// # Errors
/// A name is unknown.
pub fn named(names: &[String]) -> Result<Vec<Capture>, WorkError> {
    if let Some(wrong) = names.iter().find(|n| !CAPTURES.iter().any(|c| c.name.eq_ignore_ascii_case(n))) {
        let known = CAPTURES.map(|c| c.name).join(", ");
        return Err(WorkError::Input(format!("no capture `{wrong}`; expected some of {known}")));
    }
    let asked = |c: &Capture| names.is_empty() || names.iter().any(|n| c.name.eq_ignore_ascii_case(n));
    Ok(CAPTURES.into_iter().filter(asked).collect())
}

impl Capture {
    /// The parameters for `synth` that make this capture.
    pub fn parameters(&self, seed: u64, views: usize, (width, height): (usize, usize)) -> CaptureParams {
        let plain = CaptureParams {
            seed,
            views,
            width,
            height,
            depth_priors: false,
            place: self.place,
            physics: self.physics,
            air: self.water.is_none(),
            lamps: self.lamps,
            camera: self.camera,
            greys: self.camera == Development::Action,
            backlight: self.backlight,
            ..CaptureParams::default()
        };
        let wet = CaptureParams { water: self.water.unwrap_or(plain.water), ..plain };
        match self.physics {
            Physics::Display => wet,
            // Typical settings of cameras under water.
            Physics::Spectral => CaptureParams { auto_exposure: 1.0, white_balance: 0.5, ..wet },
        }
    }

    /// The folder of its photographs for a seed, below the folder of all captures.
    pub fn folder(&self, seed: u64) -> String {
        format!("{}-seed-{seed}", self.name)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_capture_can_be_made_differs_from_the_others_and_has_no_depth_priors() {
        let all: Vec<CaptureParams> = CAPTURES.iter().map(|c| c.parameters(3, 28, (320, 180))).collect();
        for (i, params) in all.iter().enumerate() {
            params.validate().unwrap();
            assert!(!params.depth_priors && params.seed == 3);
            assert!(all[..i].iter().all(|other| other != params), "{}", CAPTURES[i].name);
        }
        assert_eq!(all.iter().filter(|p| p.auto_exposure > 0.0).count(), 7);
        assert_eq!(all.iter().filter(|p| p.greys).count(), 3);
        assert_eq!(CAPTURES[0].folder(7), "display-I-seed-7");
    }

    #[test]
    fn captures_are_named_in_any_order_and_case_and_no_other_is_known() {
        let names = |names: &[&str]| {
            let names: Vec<String> = names.iter().map(ToString::to_string).collect();
            named(&names).map(|found| found.iter().map(|c| c.name).collect::<Vec<_>>())
        };
        assert_eq!(names(&["AIR", "display-i"]).unwrap(), ["display-I", "air"]);
        assert_eq!(names(&[]).unwrap().len(), CAPTURES.len());
        assert!(
            names(&["air", "reef"]).unwrap_err().to_string().contains("`reef`; expected some of display-I")
        );
    }
}
