//! Facts about a card that wgpu does not pass on: the size of its memory, and the number that identifies it
//! among all cards. They are read from Vulkan.

/// The facts; each is `None` if the card is used through another interface or does not report it.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub(crate) struct CardFacts {
    /// The bytes of the largest part of its own memory.
    pub(crate) memory: Option<u64>,
    /// Its UUID.
    pub(crate) uuid: Option<[u8; 16]>,
}

/// Reads the facts.
#[cfg(not(target_vendor = "apple"))]
#[expect(unsafe_code, reason = "wgpu hands out Vulkan's own handles by unsafe functions only")]
pub(crate) fn facts(adapter: &wgpu::Adapter) -> CardFacts {
    use ash::vk;

    // SAFETY: the handle is used only in this function, while the adapter lives, and nothing is destroyed.
    let Some(card) = (unsafe { adapter.as_hal::<wgpu::hal::api::Vulkan>() }) else {
        return CardFacts::default();
    };
    let shared = card.shared_instance();
    let (instance, handle) = (shared.raw_instance(), card.raw_physical_device());
    // SAFETY: the handle belongs to this instance, and the function only reads.
    let memory = unsafe { instance.get_physical_device_memory_properties(handle) };
    let local = |heap: &&vk::MemoryHeap| heap.flags.contains(vk::MemoryHeapFlags::DEVICE_LOCAL);
    let memory = memory.memory_heaps_as_slice().iter().filter(local).map(|heap| heap.size).max();
    // SAFETY: as above.
    let version = unsafe { instance.get_physical_device_properties(handle) }.api_version;
    if shared.instance_api_version().min(version) < vk::API_VERSION_1_1 {
        return CardFacts { memory, uuid: None };
    }
    let mut identity = vk::PhysicalDeviceIDProperties::default();
    let mut properties = vk::PhysicalDeviceProperties2::default().push_next(&mut identity);
    // SAFETY: as above; both versions have this function, and the structs are chained as it expects.
    unsafe { instance.get_physical_device_properties2(handle, &mut properties) };
    CardFacts { memory, uuid: Some(identity.device_uuid) }
}

/// Apple's cards are used through Metal, which has no such facts.
#[cfg(target_vendor = "apple")]
pub(crate) fn facts(_: &wgpu::Adapter) -> CardFacts {
    CardFacts::default()
}
