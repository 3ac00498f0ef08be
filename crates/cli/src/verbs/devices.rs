//! Graphics cards: lists the adapters with their features, and checks that they compute like the processor.

use crate::args::DevicesArgs;
use crate::error::Done;

#[cfg(feature = "gpu")]
pub(crate) fn run(args: &DevicesArgs) -> Done {
    use serde_json::json;
    use use3d_gpu::{AdapterReport, DeviceError, checked_adapters, environment_note};
    use use3d_workflow::machine::bytes;

    /// An adapter with the result of its check.
    #[derive(serde::Serialize)]
    struct Checked {
        #[serde(flatten)]
        adapter: AdapterReport,
        passed: bool,
        /// The summary of its kernels, if it passed.
        kernels: Option<String>,
        refusal: Option<String>,
    }

    let _ends_soon = crate::interrupt::ends_soon();
    let all = checked_adapters();
    let reports: Vec<AdapterReport> = all.iter().map(|(report, _)| report.clone()).collect();
    let note = environment_note(&reports);
    if args.json {
        let adapters: Vec<_> = all
            .iter()
            .map(|(report, said)| Checked {
                adapter: report.clone(),
                passed: said.is_ok(),
                kernels: said.as_ref().ok().cloned(),
                refusal: said.as_ref().err().map(ToString::to_string),
            })
            .collect();
        return crate::output::json(&json!({ "adapters": adapters, "note": note }));
    }
    if all.is_empty() {
        println!("{}", DeviceError::None);
        return Ok(());
    }
    if let Some(note) = note {
        println!("{note}\n");
    }
    for (number, (report, said)) in all.iter().enumerate() {
        let AdapterReport { name, kind, backend, driver, binding, buffer, workgroup, buffers, .. } = report;
        let mark = if said.is_ok() { "passed " } else { "refused" };
        println!("{mark}  #{number} {name} ({kind}, {backend})");
        println!("         driver: {driver}");
        let address = report.pci.as_ref().map(|address| format!("PCI address {address}"));
        let uuid = report.uuid.as_ref().map(|uuid| format!("UUID {uuid}"));
        let memory = report.memory.map(|memory| format!("memory {}", bytes(memory)));
        let facts: Vec<String> = [address, uuid, memory].into_iter().flatten().collect();
        if !facts.is_empty() {
            println!("         {}", facts.join(", "));
        }
        if let Some(reason) = &report.hidden {
            println!("         used only by its number, PCI address or UUID: {reason}");
        }
        println!(
            "         largest binding {}, largest buffer {}, workgroup memory {}, {buffers} buffers per kernel",
            bytes(*binding),
            bytes(*buffer),
            bytes((*workgroup).into())
        );
        if let Ok(kernels) = said {
            println!("         kernels: {kernels}");
        }
        match said {
            Err(refusal) => println!("         {refusal}\n"),
            Ok(_) if report.is_software() => println!(
                "         its kernels agree with the processor's functions; it is a software adapter, used \
                 only by name: --engine gpu:{}\n",
                name.split_whitespace().next().unwrap_or("NAME")
            ),
            Ok(_) => println!("         its kernels agree with the processor's functions\n"),
        }
    }
    Ok(())
}

#[cfg(not(feature = "gpu"))]
pub(crate) fn run(_: &DevicesArgs) -> Done {
    Err(crate::error::WorkError::input(crate::error::NO_GPU))
}
