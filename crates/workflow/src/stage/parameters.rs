//! The parameters of a stage with its defaults filled in: in the stage's own type, and as JSON for keys,
//! manifests and people. A text is read once, when the layers of a pipeline are merged.

use std::any::Any;
use std::collections::{BTreeMap, BTreeSet};
use std::fmt;
use std::sync::Arc;

use serde::Serialize;
use serde::de::DeserializeOwned;
use serde_json::Value;

use crate::error::ParameterError;
use crate::stage::reading::read;

/// The parameters of one stage. Copies share them.
#[derive(Clone)]
pub struct Parameters {
    typed: Arc<dyn Any + Send + Sync>,
    json: Arc<Value>,
}

impl Parameters {
    /// Reads the given parameters, and fills in the defaults of `P`.
    pub(super) fn read<P>(given: &Value) -> Result<Self, ParameterError>
    where
        P: Serialize + DeserializeOwned + Send + Sync + 'static,
    {
        let typed: P = read(given)?;
        let json = serde_json::to_value(&typed).map_err(|e| ParameterError::new("", e.to_string()))?;
        Ok(Self { typed: Arc::new(typed), json: Arc::new(json) })
    }

    /// The parameters in the stage's type; `None` if `P` is another type.
    pub fn of<P: 'static>(&self) -> Option<&P> {
        self.typed.downcast_ref()
    }

    /// The parameters as JSON.
    pub fn json(&self) -> &Arc<Value> {
        &self.json
    }
}

impl PartialEq for Parameters {
    fn eq(&self, other: &Self) -> bool {
        self.json == other.json
    }
}

impl fmt::Debug for Parameters {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        self.json.fmt(f)
    }
}

/// The parameters of all stages of one scene and variant.
#[derive(Clone, Debug, Default)]
pub struct AllParameters {
    pub(crate) by_stage: BTreeMap<&'static str, Parameters>,
    /// The stages that switches leave out.
    pub(crate) off: BTreeSet<&'static str>,
}

impl AllParameters {
    /// The parameters of the stage whose parameters have the type `P`; `None` if the table has no such stage.
    pub fn of<P: 'static>(&self) -> Option<&P> {
        self.by_stage.values().find_map(Parameters::of)
    }

    /// The parameters of a stage.
    pub fn get(&self, stage: &str) -> Option<&Parameters> {
        self.by_stage.get(stage)
    }
}
