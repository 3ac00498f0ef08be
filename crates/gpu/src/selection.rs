//! The choice of an adapter: by name, number, PCI address or UUID; and the cards that the environment hides.
//!
//! A cluster gives a job some cards of a node by `CUDA_VISIBLE_DEVICES`. Vulkan does not know that variable
//! and lists every card. So NVIDIA's cards that it leaves out are not used, unless a number, an address or a
//! UUID names one of them. Numbers in the variable count NVIDIA's cards. Their order is that of the PCI
//! addresses if all cards are of one kind, or if `CUDA_DEVICE_ORDER=PCI_BUS_ID` says so; otherwise only CUDA
//! knows it, and the variable is ignored.

use crate::device::{AdapterReport, DeviceError};

/// PCI's number of the maker NVIDIA.
const NVIDIA: u32 = 0x10de;
/// The fewest characters that are taken for a UUID without `GPU-` before it.
const FEWEST: usize = 8;

/// The indices of the adapters that a name refers to, in the order in which they are tried. `#2` is the
/// number of an adapter in the list, from 0. A PCI address or the beginning of a UUID names one card.
/// Otherwise the names of the adapters count, in any case: those with exactly this name, else those that
/// contain it. Without a name all that are not software are tried. Hidden cards are left out, except by
/// number, address or UUID.
pub(crate) fn order(reports: &[AdapterReport], name: Option<&str>) -> Result<Vec<usize>, DeviceError> {
    let found = || reports.iter().map(|report| report.name.clone()).collect::<Vec<_>>();
    let all = |fits: &dyn Fn(&AdapterReport) -> bool| {
        (0..reports.len()).filter(|at| fits(&reports[*at])).collect::<Vec<_>>()
    };
    // An error if every one of these is hidden.
    let shown = |fitting: Vec<usize>| {
        let shown: Vec<usize> = fitting.iter().copied().filter(|at| reports[*at].hidden.is_none()).collect();
        match fitting.first() {
            Some(&first) if shown.is_empty() => Err(DeviceError::Hidden {
                adapter: reports[first].name.clone(),
                reason: reports[first].hidden.clone().unwrap_or_default(),
            }),
            _ => Ok(shown),
        }
    };
    let Some(name) = name else {
        let cards = all(&|report| !report.is_software());
        return match (cards.is_empty(), reports.is_empty()) {
            (false, _) => shown(cards),
            (true, true) => Err(DeviceError::None),
            (true, false) => Err(DeviceError::OnlySoftware { found: found() }),
        };
    };
    let wanted = name.to_lowercase();
    if let Some(number) = wanted.strip_prefix('#') {
        let at = number.parse().ok().filter(|at| *at < reports.len());
        return match at {
            Some(at) => Ok(vec![at]),
            None => Err(DeviceError::Number { name: name.to_string(), found: found() }),
        };
    }
    // Otherwise a card whose name is the beginning of another's could never be chosen.
    let exact = all(&|report| report.name.to_lowercase() == wanted);
    if !exact.is_empty() {
        return shown(exact);
    }
    let one = all(&|report| has_address(report, &wanted) || has_uuid(report, &wanted));
    if !one.is_empty() {
        return Ok(one);
    }
    let fitting = all(&|report| report.name.to_lowercase().contains(&wanted));
    if fitting.is_empty() {
        return Err(DeviceError::Named { name: name.to_string(), found: found() });
    }
    shown(fitting)
}

/// True if a card has this PCI address, `0000:01:00.0`; the domain may be missing.
fn has_address(report: &AdapterReport, wanted: &str) -> bool {
    let Some(address) = report.pci.as_ref().map(|address| address.to_lowercase()) else { return false };
    address == wanted || address.split_once(':').is_some_and(|(_, rest)| rest == wanted)
}

/// True if a card's UUID begins so. NVIDIA's programs write `GPU-` before it; without that, a few digits
/// could be a part of a name.
fn has_uuid(report: &AdapterReport, wanted: &str) -> bool {
    let Some(uuid) = &report.uuid else { return false };
    let wanted = wanted.to_lowercase();
    let digits = |text: &str| text.replace('-', "");
    let (start, fewest) = match wanted.strip_prefix("gpu-") {
        Some(start) => (digits(start), 1),
        None => (digits(&wanted), FEWEST),
    };
    start.len() >= fewest && digits(uuid).starts_with(&start)
}

/// The values of the two variables by which CUDA's programs choose cards.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub(crate) struct CudaVariables {
    visible: Option<String>,
    order: Option<String>,
}

impl CudaVariables {
    /// The values in the environment.
    pub(crate) fn read() -> Self {
        let read = |name| std::env::var(name).ok();
        Self { visible: read("CUDA_VISIBLE_DEVICES"), order: read("CUDA_DEVICE_ORDER") }
    }

    /// Marks the cards that the variables leave out. Returns the reason if they cannot be followed.
    pub(crate) fn hide(&self, reports: &mut [AdapterReport]) -> Result<(), String> {
        let Some(value) = &self.visible else { return Ok(()) };
        let of_nvidia = |report: &AdapterReport| report.vendor == NVIDIA && !report.is_software();
        let mut cards: Vec<usize> = (0..reports.len()).filter(|at| of_nvidia(&reports[*at])).collect();
        if cards.is_empty() {
            return Ok(());
        }
        cards.sort_by(|a, b| reports[*a].pci.cmp(&reports[*b].pci));
        let numbered = self.order.as_deref() == Some("PCI_BUS_ID")
            || cards.iter().all(|at| reports[*at].name == reports[cards[0]].name);
        let mut shown = Vec::new();
        for token in value.split(',').map(str::trim) {
            let ignored = |why: &str| Err(format!("CUDA_VISIBLE_DEVICES={value} is ignored: {why}"));
            if let Ok(number) = token.parse::<usize>() {
                if !numbered {
                    return ignored(
                        "its numbers are in an order that only CUDA knows; set CUDA_DEVICE_ORDER=PCI_BUS_ID, or choose a card by its number in `use3d devices`",
                    );
                }
                // Like CUDA: the list ends at the first number that no card has.
                let Some(&at) = cards.get(number) else { break };
                shown.push(at);
            } else if token.to_uppercase().starts_with("MIG-") {
                return ignored("a part of a card (MIG) has no Vulkan driver");
            } else {
                let Some(&at) = cards.iter().find(|at| has_uuid(&reports[**at], token)) else { break };
                shown.push(at);
            }
        }
        for at in cards {
            if !shown.contains(&at) {
                reports[at].hidden = Some(format!("CUDA_VISIBLE_DEVICES={value} leaves it out"));
            }
        }
        Ok(())
    }
}

/// The indices of the adapters without those that appear a second time: a card that Vulkan offers is not used
/// through DirectX, too.
pub(crate) fn once(reports: &[AdapterReport]) -> Vec<usize> {
    let same = |a: &AdapterReport, b: &AdapterReport| (a.vendor, a.device) == (b.vendor, b.device);
    let by_vulkan = |report: &AdapterReport| report.backend == "vulkan" && report.refusal.is_none();
    let again = |report: &AdapterReport| {
        report.backend == "dx12" && reports.iter().any(|other| by_vulkan(other) && same(other, report))
    };
    (0..reports.len()).filter(|at| !again(&reports[*at])).collect()
}

#[cfg(test)]
pub(crate) mod tests {
    use super::*;

    pub(crate) fn report(name: &str, kind: &'static str) -> AdapterReport {
        AdapterReport {
            name: name.into(),
            kind,
            backend: "vulkan".into(),
            driver: "d 1".into(),
            vendor: 1,
            device: 2,
            pci: None,
            uuid: None,
            memory: None,
            binding: 1 << 31,
            buffer: 1 << 31,
            workgroup: 32 << 10,
            buffers: 32,
            subgroup: [8, 8],
            hidden: None,
            refusal: None,
        }
    }

    /// A node with four cards of NVIDIA and a software adapter; the list is not in the order of addresses.
    fn node() -> Vec<AdapterReport> {
        let card = |bus: usize, uuid: &str| AdapterReport {
            vendor: NVIDIA,
            pci: Some(format!("0000:{bus:02x}:00.0")),
            uuid: Some(uuid.into()),
            ..report("NVIDIA H200", "discrete")
        };
        vec![
            card(0xc1, "dddddddd-0000-0000-0000-000000000004"),
            card(0x01, "aaaaaaaa-0000-0000-0000-000000000001"),
            card(0x41, "bbbbbbbb-0000-0000-0000-000000000002"),
            card(0x81, "cccccccc-0000-0000-0000-000000000003"),
            report("llvmpipe", "software"),
        ]
    }

    fn variables(visible: &str, order: Option<&str>) -> CudaVariables {
        CudaVariables { visible: Some(visible.into()), order: order.map(String::from) }
    }

    #[test]
    fn a_card_is_chosen_by_number_by_address_and_by_uuid() {
        let node = node();
        for (name, expected) in [
            ("#2", vec![2]),
            ("#4", vec![4]),
            ("0000:C1:00.0", vec![0]),
            ("41:00.0", vec![2]),
            ("GPU-cccccccc-0000", vec![3]),
            ("CCCCCCCC", vec![3]),
            ("GPU-cc", vec![3]),
            ("h200", vec![0, 1, 2, 3]),
        ] {
            assert_eq!(order(&node, Some(name)), Ok(expected), "{name}");
        }
        // Too few digits of a UUID are none.
        assert!(matches!(order(&node, Some("cccc")), Err(DeviceError::Named { .. })));
        for name in ["#5", "#-1", "#x"] {
            let said = order(&node, Some(name)).unwrap_err().to_string();
            assert!(
                said.contains(name) && said.contains("#0 NVIDIA H200") && said.contains("#4 llvmpipe"),
                "{said}"
            );
        }
    }

    #[test]
    fn cards_that_cuda_would_not_see_are_used_only_if_they_are_named_exactly() {
        for (visible, expected) in [
            ("1", vec![2]),
            ("3, 0", vec![0, 1]),
            ("GPU-aaaaaaaa-0000-0000-0000-000000000001,2", vec![1, 3]),
            ("0,7,1", vec![1]),
            ("GPU-bb", vec![2]),
        ] {
            let mut node = node();
            variables(visible, None).hide(&mut node).unwrap();
            assert_eq!(order(&node, None), Ok(expected.clone()), "{visible}");
            assert_eq!(order(&node, Some("nvidia")), Ok(expected), "{visible}");
            assert_eq!(order(&node, Some("81:00.0")), Ok(vec![3]), "{visible}");
            assert_eq!((order(&node, Some("#0")), order(&node, Some("llvm"))), (Ok(vec![0]), Ok(vec![4])));
        }
        for visible in ["", "-1", "9"] {
            let mut node = node();
            variables(visible, None).hide(&mut node).unwrap();
            let said = order(&node, None).unwrap_err().to_string();
            assert!(said.contains("CUDA_VISIBLE_DEVICES=") && said.contains("H200"), "{said}");
        }
    }

    #[test]
    fn variables_that_cannot_be_followed_hide_nothing_and_say_so() {
        let mut mixed = node();
        mixed[1].name = "NVIDIA L4".into();
        let said = variables("1", None).hide(&mut mixed).unwrap_err();
        assert!(said.contains("CUDA_DEVICE_ORDER") && mixed.iter().all(|r| r.hidden.is_none()), "{said}");
        variables("1", Some("PCI_BUS_ID")).hide(&mut mixed).unwrap();
        assert_eq!(order(&mixed, None), Ok(vec![2]));
        let said = variables("MIG-1234", None).hide(&mut node()).unwrap_err();
        assert!(said.contains("MIG"), "{said}");
        // Cards of other makers are never hidden.
        let mut other = vec![report("Radeon", "discrete")];
        variables("", None).hide(&mut other).unwrap();
        assert_eq!(order(&other, None), Ok(vec![0]));
    }

    #[test]
    fn a_card_that_vulkan_offers_is_not_used_through_directx_too() {
        let card = report("Radeon", "discrete");
        let again = AdapterReport { backend: "dx12".into(), ..card.clone() };
        let other = AdapterReport { device: 3, ..again.clone() };
        assert_eq!(once(&[card.clone(), again.clone(), other]), [0, 2]);
        let old = AdapterReport { refusal: Some(DeviceError::None), ..card };
        assert_eq!(once(&[old, again]), [0, 1]);
        // The numbers of CUDA count each card once.
        let twice = |report: &AdapterReport| {
            [report.clone(), AdapterReport { backend: "dx12".into(), ..report.clone() }]
        };
        let all: Vec<AdapterReport> = node()[..4].iter().flat_map(twice).collect();
        let mut left: Vec<AdapterReport> = once(&all).into_iter().map(|at| all[at].clone()).collect();
        variables("1", None).hide(&mut left).unwrap();
        assert_eq!((left.len(), order(&left, None)), (4, Ok(vec![2])));
    }
}
