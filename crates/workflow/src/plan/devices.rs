//! The class of arithmetic of a node, which is part of its key.
//!
//! A stage on a graphics card has the class of the card. A process that computes opens the card. One that
//! only looks, or that runs on a machine without the card, takes the class from the cache. There it may read
//! what the card has made, and computes nothing in its place.

use crate::plan::builder::Builder;
use crate::plan::graph::Graph;
use crate::stage::definition::Stage;
use crate::stage::parameters::Parameters;

/// A class of arithmetic.
pub(crate) struct Arithmetic {
    /// Its name in a key.
    pub(crate) class: String,
    /// The reason why this process cannot compute in it.
    pub(crate) elsewhere: Option<String>,
}

impl Builder {
    /// The first stage of a graph whose device depends on the machine, with the parameter that chooses it.
    pub fn undecided_device(&self, graph: &Graph) -> Option<(&'static str, &'static str)> {
        graph.nodes.iter().find_map(|node| {
            let device = self.registry.stages()[node.stage].device.as_ref()?;
            let asked = (device.asked)(&node.parameters)?;
            (!asked.required).then_some((node.stage_name, device.parameter))
        })
    }

    /// The class of arithmetic of a stage with these parameters, with the programs of others that it runs, or
    /// the reason why it is not known yet.
    pub(crate) fn arithmetic(&self, stage: &Stage, parameters: &Parameters) -> Result<Arithmetic, String> {
        let of_device = self.of_device(stage, parameters)?;
        Ok(match &stage.made_with {
            Some(programs) => {
                Arithmetic { class: format!("{}; {}", programs(parameters), of_device.class), ..of_device }
            }
            None => of_device,
        })
    }

    fn of_device(&self, stage: &Stage, parameters: &Parameters) -> Result<Arithmetic, String> {
        let machine = &self.numeric_class;
        let of_machine = || Arithmetic { class: machine.clone(), elsewhere: None };
        let Some(device) = &stage.device else { return Ok(of_machine()) };
        let Some(asked) = (device.asked)(parameters) else { return Ok(of_machine()) };
        let cache = &self.cache;
        let known = |why: String| match cache.known_device(&asked.name, &asked.programs) {
            Some(class) => Ok(Arithmetic { class: class.on(machine), elsewhere: Some(why) }),
            None => Err(why),
        };
        if self.only_looks {
            let unknown = known("this command computes nothing".to_string());
            return match unknown {
                Err(_) if asked.required => {
                    Err(format!("no device has answered to `{}` in this cache yet", asked.name))
                }
                other => Ok(other.unwrap_or_else(|_| of_machine())),
            };
        }
        let own = match (device.here)(parameters) {
            Ok(None) => return Ok(of_machine()),
            Ok(Some(own)) => own,
            Err(why) => return known(why),
        };
        let first = cache.answer(&asked.name, &own).unwrap_or_else(|error| {
            tracing::warn!("{error}; machines without this device cannot look at its results");
            own.clone()
        });
        let elsewhere = (first != own).then(|| {
            format!(
                "a machine with {} (driver {}), on which this submission computes; this machine has {} (driver {})",
                first.adapter, first.driver, own.adapter, own.driver
            )
        });
        Ok(Arithmetic { class: first.on(machine), elsewhere })
    }
}
