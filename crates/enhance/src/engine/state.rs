//! The state of stage 2 between two steps: an engine starts from it, and a checkpoint stores it.

use serde::{Deserialize, Serialize};
use use3d_training::EngineError;
use use3d_ubaf::Field;

/// The field's parameters with Adam's moments, in the field's order.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct FieldState {
    /// The version of this record's format, [`FieldState::VERSION`].
    pub version: u32,
    /// Parameters.
    pub parameters: Vec<f32>,
    /// Means of gradients.
    pub first: Vec<f32>,
    /// Means of squared gradients.
    pub second: Vec<f32>,
}

impl FieldState {
    /// The current version of this record's format.
    pub const VERSION: u32 = 2;

    /// The state at the start of a run with this field.
    pub fn new(field: &Field) -> Self {
        let zeros = vec![0.0; field.parameters.len()];
        Self {
            version: Self::VERSION,
            parameters: field.parameters.clone(),
            first: zeros.clone(),
            second: zeros,
        }
    }

    /// Checks that the version is the current one and that all lengths are those of a field with this
    /// number of parameters.
    pub fn check(&self, parameters: usize) -> Result<(), EngineError> {
        if self.version != Self::VERSION {
            let (found, known) = (self.version, Self::VERSION);
            let what = format!("it is of version {found}, expected {known}; start from the beginning");
            return Err(EngineError::State(what));
        }
        let lengths = [self.parameters.len(), self.first.len(), self.second.len()];
        if lengths != [parameters; 3] {
            let what = format!("it holds {lengths:?} parameters and moments, the field has {parameters}");
            return Err(EngineError::State(what));
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use use3d_ubaf::{FieldBox, Shape};

    use super::*;

    #[test]
    fn a_state_of_another_field_or_version_is_refused() {
        let bounds = FieldBox { low: [0.0; 3], high: [1.0; 3] };
        let field = Field::identity(Shape::default(), bounds, 1).unwrap();
        let state = FieldState::new(&field);
        state.check(field.parameters.len()).unwrap();
        let error = state.check(field.parameters.len() + 1).unwrap_err().to_string();
        assert!(error.contains("the field has"), "{error}");
        let old = FieldState { version: 1, ..state };
        let error = old.check(field.parameters.len()).unwrap_err().to_string();
        assert!(error.contains("version 1, expected 2"), "{error}");
    }
}
