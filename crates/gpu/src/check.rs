//! The quick check before an adapter is used: compares kernels and a whole step of stage 1 on a small scene
//! with those of the processor.
//!
//! Drivers have bugs that corrupt numbers without an error, and these must not be found only after hours of
//! training. The error contains the name of the adapter and its driver, because another driver may solve
//! the problem.

use use3d_training::EngineError;

use crate::device::{AdapterChoice, DeviceError, Gpu, found, listed, take_first};
use crate::twins::{self, Agreement};
use crate::variant::Variant;

/// A reason why an adapter must not be used.
#[derive(Debug, thiserror::Error)]
pub enum CheckError {
    /// It could not be opened, or does not meet the requirements.
    #[error(transparent)]
    Device(#[from] DeviceError),
    /// It failed during the check.
    #[error(
        "the adapter `{adapter}` ({driver}) failed its check: {error}; update its driver or use another engine"
    )]
    Failed {
        /// Its name.
        adapter: String,
        /// Its driver.
        driver: String,
        /// The error.
        error: EngineError,
    },
    /// Its results differ from the processor's.
    #[error(
        "the adapter `{adapter}` ({driver}) computes wrongly: {what} differ from the processor's by {error:.1e}, at most {bar:.0e} is right; update its driver or use another engine"
    )]
    Wrong {
        /// Its name.
        adapter: String,
        /// Its driver.
        driver: String,
        /// The compared quantity.
        what: String,
        /// The difference.
        error: f64,
        /// The largest allowed difference.
        bar: f64,
    },
    /// Several adapters were tried.
    #[error("{}", listed(.0))]
    Several(Vec<CheckError>),
}

impl CheckError {
    /// The error's text without the adapter's name, for use after the name.
    fn reason(&self) -> String {
        match self {
            Self::Failed { error, .. } => error.to_string(),
            Self::Wrong { what, error, bar, .. } => {
                format!("{what} differ from the processor's by {error:.1e}, at most {bar:.0e} is right")
            }
            Self::Device(_) | Self::Several(_) => self.to_string(),
        }
    }
}

/// Returns an error for the first comparison that fails.
fn verdict(gpu: &Gpu, found: Result<Vec<Agreement>, EngineError>) -> Result<(), CheckError> {
    let (adapter, driver) = (gpu.adapter.name.clone(), gpu.adapter.driver.clone());
    match found {
        Err(error) => Err(CheckError::Failed { adapter, driver, error }),
        Ok(all) => match all.into_iter().find(|agreement| !agreement.holds()) {
            Some(Agreement { what, error, bar, .. }) => {
                Err(CheckError::Wrong { adapter, driver, what, error, bar })
            }
            None => Ok(()),
        },
    }
}

/// Checks an open device.
pub fn check(gpu: &Gpu) -> Result<(), CheckError> {
    verdict(gpu, twins::small(gpu))
}

/// Opens the first adapter that passes its check. A candidate has this number (`#0`), PCI address, UUID or
/// name, or has it as a part of its name; without a name, all that are not software are candidates. An
/// adapter that computes wrongly with subgroup operations is used without them if it passes then.
pub fn open_checked(name: Option<&str>) -> Result<Gpu, CheckError> {
    take_first(name, open_sound, CheckError::Several)
}

fn open_sound(found: &AdapterChoice) -> Result<Gpu, CheckError> {
    sound(|| Ok(Gpu::of(found)?), check)
}

/// Opens a device that passes `test`, with the portable kernels if needed. It is opened again for these,
/// because the test of the others may have lost the device.
fn sound(
    open: impl Fn() -> Result<Gpu, CheckError>,
    test: impl Fn(&Gpu) -> Result<(), CheckError>,
) -> Result<Gpu, CheckError> {
    let gpu = open()?;
    match test(&gpu) {
        Ok(()) => Ok(gpu),
        Err(wrong) if gpu.variant == Variant::Portable => Err(wrong),
        Err(wrong) => {
            let gpu = open()?.fallen_back(&wrong.reason());
            test(&gpu).map(|()| gpu)
        }
    }
}

/// Lists every adapter of this machine, the most suitable first, with the result of its check: the variant
/// of its kernels ([`Gpu::kernels`]), or the reason why it is refused.
pub fn checked_adapters() -> Vec<(crate::AdapterReport, Result<String, CheckError>)> {
    let said = |found: AdapterChoice| {
        let said = open_sound(&found).map(|gpu| gpu.kernels());
        (found.report, said)
    };
    found().into_iter().map(said).collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::test_support::software;

    #[test]
    fn a_sound_adapter_passes_and_a_lost_one_is_told_by_name() {
        let Some(gpu) = software() else { return };
        check(&gpu).unwrap();
        gpu.lose();
        let error = check(&gpu).unwrap_err().to_string();
        assert!(error.contains("llvmpipe") && error.contains("failed its check"), "{error}");
    }

    #[test]
    fn a_device_passes_in_each_of_its_variants() {
        let Some(gpu) = software() else { return };
        let variants = gpu.variants();
        assert!(variants.len() == 2 && gpu.variant == Variant::Portable, "{variants:?}");
        for variant in variants {
            let gpu = sound(|| Ok(gpu.clone().with(variant)), check).unwrap();
            assert_eq!((gpu.variant, gpu.kernels()), (variant, variant.to_string()));
        }
        assert_eq!(
            gpu.with(Variant::Subgroups { width: 64, pixels: 2 }).variant,
            Variant::Portable,
            "not its width"
        );
    }

    #[test]
    fn a_device_that_fails_with_subgroups_alone_says_so() {
        let Some(gpu) = software() else { return };
        let wide = gpu.variants().pop().unwrap();
        let test = |gpu: &Gpu| match gpu.variant {
            Variant::Portable => Ok(()),
            Variant::Subgroups { .. } => {
                let error = EngineError::Failed("the driver does not compile them".into());
                verdict(gpu, Err(error))
            }
        };
        let taken = sound(|| Ok(gpu.clone().with(wide)), test).unwrap();
        assert_eq!(taken.kernels(), "portable (with subgroups: the driver does not compile them)");
        let never = |gpu: &Gpu| verdict(gpu, Err(EngineError::Failed("nothing works".into())));
        assert!(sound(|| Ok(gpu.clone().with(wide)), never).is_err());
    }

    #[test]
    fn what_differs_is_told_with_adapter_and_driver() {
        let Some(gpu) = software() else { return };
        let agreement =
            |error| Agreement { what: "slopes of the image".into(), error, bar: 1e-5, digest: [0; 32] };
        assert!(verdict(&gpu, Ok(vec![agreement(1e-6), agreement(1e-5)])).is_ok());
        for error in [2e-5, f64::INFINITY, f64::NAN] {
            let said = verdict(&gpu, Ok(vec![agreement(1e-6), agreement(error)])).unwrap_err().to_string();
            assert!(said.contains("slopes of the image") && said.contains(&gpu.adapter.driver), "{said}");
        }
        let named = open_checked(Some("no such card")).unwrap_err().to_string();
        assert!(named.contains("no such card") && named.contains("llvmpipe"), "{named}");
    }
}
