//! Parameters of single training views: a row of numbers per view, which only that view's steps change.
//!
//! ```text
//! x_v ← Adam(x_v, ∂L/∂x_v, m_v, u_v, k_v)        in a step on the view v, and in no other
//! ```
//!
//! | symbol | meaning | shape |
//! |---|---|---|
//! | x | the parameters | views × width |
//! | m, u | means of gradients and of squared gradients | views × width each |
//! | k | Adam's steps of each view, because a view's moments move in its own steps only | views |
//!
//! Today's only kind are the views' log-gains ([`exposure`](crate::exposure)). Every other kind is one more
//! field of the state: checkpoints and engines handle all kinds alike.

use serde::{Deserialize, Serialize};
use use3d_numerics::adam::Adam;
use use3d_training::EngineError;

/// The parameters of all training views with Adam's moments; no rows if no view has any.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct ViewParameters {
    /// Numbers of a row.
    pub width: usize,
    /// x, row by row.
    pub values: Vec<f32>,
    /// m, like the values.
    pub first: Vec<f32>,
    /// u, like the values.
    pub second: Vec<f32>,
    /// k, one per view.
    pub steps: Vec<u64>,
}

impl ViewParameters {
    /// Starts from these rows of `width` numbers; a rest of them is left out.
    pub fn new(width: usize, mut values: Vec<f32>) -> Self {
        let views = values.len().checked_div(width).unwrap_or(0);
        values.truncate(views * width);
        let zeros = vec![0.0; values.len()];
        Self { width, values, first: zeros.clone(), second: zeros, steps: vec![0; views] }
    }

    /// Number of rows.
    pub fn views(&self) -> usize {
        self.steps.len()
    }

    /// The parameters of a view; `None` for a view without any.
    pub fn row(&self, view: usize) -> Option<&[f32]> {
        self.values.get(view * self.width..(view + 1) * self.width).filter(|row| !row.is_empty())
    }

    /// Makes one Adam step of a view's parameters. A view without any is left alone.
    ///
    /// # Panics
    /// The gradient is not as wide as a row.
    pub fn update(&mut self, view: usize, rate: f64, gradient: &[f32]) {
        let Some(count) = self.steps.get_mut(view) else { return };
        *count += 1;
        let row = view * self.width..(view + 1) * self.width;
        let (m, u) = (&mut self.first[row.clone()], &mut self.second[row.clone()]);
        Adam::SPLATTING.update(*count, rate, &mut self.values[row], gradient, m, u);
    }

    /// True if every parameter is finite.
    pub fn is_finite(&self) -> bool {
        self.values.iter().all(|v| v.is_finite())
    }

    /// Checks that there are no rows, or that every view has one of `width` numbers.
    ///
    /// # Errors
    /// The lengths do not agree; the message calls the parameters `what`.
    pub fn check(&self, what: &str, width: usize, views: usize) -> Result<(), EngineError> {
        let rows = self.views();
        let lengths = [self.values.len(), self.first.len(), self.second.len()];
        let agrees = lengths == [rows * width; 3] && (rows == 0 || self.width == width);
        if agrees && [0, views].contains(&rows) {
            return Ok(());
        }
        Err(EngineError::State(format!(
            "its {what} have {rows} rows with {lengths:?} numbers, expected none or {views} rows of {width}"
        )))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn only_the_steps_of_a_view_move_its_row_whatever_its_width() {
        for width in [1, 3, 6] {
            let start: Vec<f32> = (0..4 * width).map(|i| i as f32).collect();
            let mut parameters = ViewParameters::new(width, start.clone());
            let gradient: Vec<f32> = (0..width).map(|i| i as f32 - 0.5).collect();
            for _ in 0..3 {
                parameters.update(2, 0.01, &gradient);
                parameters.update(9, 0.01, &gradient);
            }
            let (mut row, mut m, mut u) =
                (start[2 * width..3 * width].to_vec(), vec![0.0; width], vec![0.0; width]);
            for step in 1..=3 {
                Adam::SPLATTING.update(step, 0.01, &mut row, &gradient, &mut m, &mut u);
            }
            assert_eq!(parameters.row(2), Some(&row[..]));
            assert_eq!(parameters.row(1), Some(&start[width..2 * width]));
            assert_eq!((parameters.row(4), parameters.steps.clone()), (None, vec![0, 0, 3, 0]));
            parameters.check("rows", width, 4).unwrap();
            assert!(parameters.check("rows", width, 5).unwrap_err().to_string().contains("5 rows"));
            assert!(parameters.check("rows", width + 1, 4).is_err());
            parameters.second.pop();
            assert!(parameters.check("rows", width, 4).is_err());
        }
        ViewParameters::default().check("rows", 6, 9).unwrap();
    }

    #[test]
    fn rows_of_any_kind_go_through_a_checkpoint() {
        let dir = tempfile::tempdir().unwrap();
        let file = use3d_training::CheckpointFile::new(dir.path(), "rows");
        let mut parameters = ViewParameters::new(6, vec![0.25; 18]);
        parameters.update(1, 0.1, &[1.0; 6]);
        file.save(&parameters).unwrap();
        let read: ViewParameters = file.load().unwrap().unwrap();
        assert_eq!(read, parameters);
    }
}
