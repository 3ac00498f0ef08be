//! The check before an adapter is used: kernels and a whole step of stage 1 on a small scene
//! beside the processor's, in a moment.
//!
//! Drivers have bugs that corrupt numbers without an error; a training of hours is no place to find them.
//! What is wrong is told with the adapter's name and its driver, since another driver may be the remedy.

use use3d_training::EngineError;

use crate::device::{DeviceError, Gpu, adapters};
use crate::twins::{self, Agreement};
use crate::variant::Variant;

/// Why an adapter is not to be used.
#[derive(Debug, thiserror::Error)]
pub enum CheckError {
    /// It could not be opened, or does not fit.
    #[error(transparent)]
    Device(#[from] DeviceError),
    /// It failed on the way.
    #[error(
        "the adapter `{adapter}` ({driver}) failed its check: {error}; update its driver or use another engine"
    )]
    Failed {
        /// Its name.
        adapter: String,
        /// Its driver.
        driver: String,
        /// What failed.
        error: EngineError,
    },
    /// It computes something else than the processor.
    #[error(
        "the adapter `{adapter}` ({driver}) computes wrongly: {what} differ from the processor's by {error:.1e}, at most {bar:.0e} is right; update its driver or use another engine"
    )]
    Wrong {
        /// Its name.
        adapter: String,
        /// Its driver.
        driver: String,
        /// Of what.
        what: String,
        /// How far off it is.
        error: f64,
        /// The most it may be.
        bar: f64,
    },
}

/// What does not hold, if anything.
fn verdict(gpu: &Gpu, found: Result<Vec<Agreement>, EngineError>) -> Result<(), CheckError> {
    let (adapter, driver) = (gpu.adapter().name.clone(), gpu.adapter().driver.clone());
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

/// Opens the adapter whose name contains `name`, without a name the best that is no software, and checks it.
/// One that computes wrongly with operations across threads is taken without them if it is sound then.
pub fn open_checked(name: Option<&str>) -> Result<Gpu, CheckError> {
    sound(Gpu::open(name)?)
}

fn sound(gpu: Gpu) -> Result<Gpu, CheckError> {
    match check(&gpu) {
        Ok(()) => Ok(gpu),
        Err(wrong) if gpu.variant() == Variant::Portable => Err(wrong),
        Err(_) => {
            let gpu = gpu.with(Variant::Portable);
            check(&gpu).map(|()| gpu)
        }
    }
}

/// Every adapter of this machine, the likeliest first, with what the check says of it.
pub fn checked_adapters() -> Vec<(crate::AdapterReport, Result<(), CheckError>)> {
    adapters()
        .into_iter()
        .map(|report| {
            let said = match &report.refusal {
                Some(refusal) => Err(refusal.clone().into()),
                None => open_checked(Some(&report.name)).map(|_| ()),
            };
            (report, said)
        })
        .collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::testing::software;

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
        assert!(variants.len() == 2 && gpu.variant() == Variant::Portable, "{variants:?}");
        for variant in variants {
            let gpu = sound(gpu.clone().with(variant)).unwrap();
            assert_eq!(gpu.variant(), variant);
        }
        assert_eq!(
            gpu.with(Variant::Subgroups { width: 64, pixels: 2 }).variant(),
            Variant::Portable,
            "not its width"
        );
    }

    #[test]
    fn what_differs_is_told_with_adapter_and_driver() {
        let Some(gpu) = software() else { return };
        let agreement =
            |error| Agreement { what: "slopes of the image".into(), error, bar: 1e-5, digest: [0; 32] };
        assert!(verdict(&gpu, Ok(vec![agreement(1e-6), agreement(1e-5)])).is_ok());
        for error in [2e-5, f64::INFINITY, f64::NAN] {
            let said = verdict(&gpu, Ok(vec![agreement(1e-6), agreement(error)])).unwrap_err().to_string();
            assert!(said.contains("slopes of the image") && said.contains(&gpu.adapter().driver), "{said}");
        }
        let named = open_checked(Some("no such card")).unwrap_err().to_string();
        assert!(named.contains("no such card") && named.contains("llvmpipe"), "{named}");
    }
}
