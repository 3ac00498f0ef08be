//! The devices that stages compute on besides the processor.

use std::sync::Arc;

use crate::cache::key::DeviceClass;
use crate::stage::parameters::Parameters;
use use3d_code::digest::Digest;

/// The device that parameters ask for.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct AskedDevice {
    /// Its name in the parameters.
    pub name: String,
    /// False if the processor stands in for a device that is missing.
    pub required: bool,
    /// The digest of the programs that run on it, which this process has.
    pub programs: Digest,
}

type Asked = Arc<dyn Fn(&Parameters) -> Option<AskedDevice> + Send + Sync>;
type Here = Arc<dyn Fn(&Parameters) -> Result<Option<DeviceClass>, String> + Send + Sync>;

/// The device of a stage.
#[derive(Clone)]
pub struct Device {
    /// The parameter that chooses it.
    pub(crate) parameter: &'static str,
    /// The device that given parameters ask for; `None` for the processor alone.
    pub(crate) asked: Asked,
    /// The class of the one that this machine has; `None` for the processor, or the reason why the requested
    /// one is not there.
    pub(crate) here: Here,
}
