//! The adapters of this machine in words, and the reasons why one cannot be used.

use serde::Serialize;

use crate::vulkan::{CardFacts, facts};

/// The smallest limits that every adapter must offer.
const STORAGE_BUFFERS: u32 = 10;
const WORKGROUP_BYTES: u32 = 20 * 1024;
const BINDING_BYTES: u64 = 128 << 20;

/// Largest number of bytes that wgpu allocates on a device when it is opened: a block of its allocator for
/// buffers and one for data that passes through main memory.
pub(crate) const OPENING: u64 = 192 << 20;

/// A reason why there is no device.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
pub enum DeviceError {
    /// There is no adapter.
    #[error("{NOTHING}")]
    None,
    /// There are only software adapters, and none was named.
    #[error(
        "no graphics card was found, only software adapters: {}; name one to use it all the same (`--engine gpu:{}`), or use the processor (`--engine cpu`)", .found.join(", "), first_word(.found)
    )]
    OnlySoftware {
        /// Their names.
        found: Vec<String>,
    },
    /// No adapter has such a name.
    #[error("no adapter's name has `{name}` in it{}", others(.found))]
    Named {
        /// The requested name.
        name: String,
        /// The adapters' names.
        found: Vec<String>,
    },
    /// There is no adapter of this number.
    #[error("`{name}` is no number of an adapter; there are: {}", numbered(.found))]
    Number {
        /// The requested number.
        name: String,
        /// The adapters' names.
        found: Vec<String>,
    },
    /// The environment hides every card that would be used.
    #[error(
        "the card `{adapter}` is not used: {reason}; choose it by its number, PCI address or UUID (`use3d devices` lists them), or change that variable"
    )]
    Hidden {
        /// The name of the first of these cards.
        adapter: String,
        /// The reason.
        reason: String,
    },
    /// An adapter cannot run the kernels.
    #[error(
        "the adapter `{adapter}` has {found} {what}, {needed} are needed; update its driver or use another engine"
    )]
    Limit {
        /// Its name.
        adapter: String,
        /// The limit that is too small.
        what: &'static str,
        /// The adapter's value.
        found: u64,
        /// The required value.
        needed: u64,
    },
    /// The driver could not open the adapter.
    #[error(
        "the adapter `{adapter}` could not be opened: {reason}; free some of its memory if that is short (opening takes up to {} MiB of it), update its driver, or use another engine", OPENING >> 20
    )]
    Open {
        /// Its name.
        adapter: String,
        /// The driver's message.
        reason: String,
    },
    /// Several adapters were tried.
    #[error("{}", listed(.0))]
    Several(Vec<DeviceError>),
}

/// The message if there is no adapter.
const NOTHING: &str = "no graphics card was found: neither Vulkan's loader (`libvulkan.so.1`, package `libvulkan1`) nor another driver answered; install the card's driver, or use the processor (`--engine cpu`)";

/// The part of a message that lists the adapters that exist.
fn others(found: &[String]) -> String {
    if found.is_empty() { format!(": {NOTHING}") } else { format!("; there are: {}", found.join(", ")) }
}

/// The part of a message that lists the adapters with their numbers.
fn numbered(found: &[String]) -> String {
    if found.is_empty() {
        return "none".into();
    }
    let each = found.iter().enumerate().map(|(at, name)| format!("#{at} {name}"));
    each.collect::<Vec<_>>().join(", ")
}

/// A message with the reason why each of several adapters cannot be used.
pub(crate) fn listed(refusals: &[impl std::fmt::Display]) -> String {
    let each = refusals.iter().zip(1..).map(|(refusal, at)| format!("({at}) {refusal}"));
    let each: Vec<String> = each.collect();
    format!("none of {} adapters can be used: {}", each.len(), each.join("; "))
}

fn first_word(names: &[String]) -> &str {
    names.first().and_then(|name| name.split_whitespace().next()).unwrap_or("NAME")
}

/// The description of an adapter for the user.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize)]
pub struct AdapterReport {
    /// Its name.
    pub name: String,
    /// `discrete`, `integrated`, `virtual`, `software` or `other`.
    pub kind: &'static str,
    /// The interface through which it is used, such as `vulkan`.
    pub backend: String,
    /// Name and version of its driver.
    pub driver: String,
    /// Number of its maker.
    #[serde(skip)]
    pub vendor: u32,
    /// Number of its model.
    #[serde(skip)]
    pub device: u32,
    /// Its PCI address, such as `0000:01:00.0`, if it has one.
    #[serde(rename = "pci_address")]
    pub pci: Option<String>,
    /// Its UUID, as the maker's programs print it, if its driver reports it.
    pub uuid: Option<String>,
    /// Bytes of its own memory, if its driver reports them.
    #[serde(rename = "memory_bytes")]
    pub memory: Option<u64>,
    /// The reason why it is used only if its number, PCI address or UUID is given.
    pub hidden: Option<String>,
    /// Largest buffer that a kernel can bind, bytes.
    #[serde(rename = "largest_binding_bytes")]
    pub binding: u64,
    /// Largest buffer, bytes.
    #[serde(rename = "largest_buffer_bytes")]
    pub buffer: u64,
    /// Memory that the threads of a workgroup share, bytes.
    #[serde(rename = "workgroup_memory_bytes")]
    pub workgroup: u32,
    /// Number of buffers that a kernel can bind.
    #[serde(rename = "buffers_per_kernel")]
    pub buffers: u32,
    /// Smallest and largest number of threads in a subgroup.
    #[serde(rename = "subgroup_threads")]
    pub subgroup: [u32; 2],
    /// The reason why it cannot be used; `None` if it can.
    #[serde(skip)]
    pub refusal: Option<DeviceError>,
}

impl AdapterReport {
    pub(crate) fn of(adapter: &wgpu::Adapter) -> Self {
        let (info, limits) = (adapter.get_info(), adapter.limits());
        let CardFacts { memory, uuid } = facts(adapter);
        let address = info.device_pci_bus_id;
        let kind = match info.device_type {
            wgpu::DeviceType::DiscreteGpu => "discrete",
            wgpu::DeviceType::IntegratedGpu => "integrated",
            wgpu::DeviceType::VirtualGpu => "virtual",
            wgpu::DeviceType::Cpu => "software",
            wgpu::DeviceType::Other => "other",
        };
        let mut report = Self {
            name: info.name,
            kind,
            backend: info.backend.to_string(),
            driver: format!("{} {}", info.driver, info.driver_info).trim().to_string(),
            vendor: info.vendor,
            device: info.device,
            pci: (!address.is_empty()).then_some(address),
            uuid: uuid.map(uuid_text),
            memory,
            binding: limits.max_storage_buffer_binding_size,
            buffer: limits.max_buffer_size,
            workgroup: limits.max_compute_workgroup_storage_size,
            buffers: limits.max_storage_buffers_per_shader_stage,
            subgroup: [info.subgroup_min_size, info.subgroup_max_size],
            ..Self::default()
        };
        report.refusal = report.check().err();
        report
    }

    /// True if it is a software adapter, which runs on the processor.
    pub fn is_software(&self) -> bool {
        self.kind == "software"
    }

    pub(crate) fn check(&self) -> Result<(), DeviceError> {
        for (what, found, needed) in [
            ("storage buffers per kernel", self.buffers.into(), u64::from(STORAGE_BUFFERS)),
            ("bytes of workgroup memory", self.workgroup.into(), u64::from(WORKGROUP_BYTES)),
            ("bytes in the largest binding", self.binding, BINDING_BYTES),
        ] {
            if found < needed {
                return Err(DeviceError::Limit { adapter: self.name.clone(), what, found, needed });
            }
        }
        Ok(())
    }

    /// The adapter's position in the order: discrete, integrated, virtual, other, and software last.
    pub(crate) fn rank(&self) -> usize {
        ["discrete", "integrated", "virtual", "other", "software"]
            .iter()
            .position(|kind| *kind == self.kind)
            .unwrap_or(usize::MAX)
    }
}

/// A UUID in the usual form.
fn uuid_text(bytes: [u8; 16]) -> String {
    let hex: String = bytes.iter().map(|byte| format!("{byte:02x}")).collect();
    format!("{}-{}-{}-{}-{}", &hex[..8], &hex[8..12], &hex[12..16], &hex[16..20], &hex[20..])
}
