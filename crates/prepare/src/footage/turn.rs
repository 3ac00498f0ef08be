//! The turn of a film: the matrix by which a player turns stored frames, and cameras of turned pictures.
//!
//! The matrix is that of MP4 and QuickTime files, row by row, with 16 fraction bits (30 in the last column):
//! `(x', y', 1) = (x, y, 1) [a b u; c d v; t_x t_y w]`. A player keeps the result in its upper left corner.
//!
//! A picture of `w × h` pixels that is turned clockwise by a quarter has `x' = h - y`, `y' = x`. So the
//! stored picture's camera sees `x = y'`, `y = w' - x'`: with `f` and `c` of the turned picture, `f = (f_y',
//! f_x')`, `c = (c_y', w' - c_x')`, and `R = [0 1 0; -1 0 0; 0 0 1] R'`.

use glam::{DMat3, DVec3};
use use3d_capture::{Camera, Intrinsics, Pose};

/// The matrix by which a player turns stored frames.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct DisplayMatrix(pub [i32; 9]);

/// The matrix that turns nothing.
const IDENTITY: [i32; 9] = [1 << 16, 0, 0, 0, 1 << 16, 0, 0, 0, 1 << 30];

impl DisplayMatrix {
    /// True if it turns and shifts nothing.
    pub fn is_identity(&self) -> bool {
        self.0 == IDENTITY
    }

    /// The number of clockwise quarter turns from the stored frame to the shown one, 0 to 3; `None` if the
    /// matrix mirrors, or turns by another angle.
    pub fn quarter_turns(&self) -> Option<u8> {
        let [a, b, _, c, d, ..] = self.0;
        match (a.signum(), b.signum(), c.signum(), d.signum()) {
            (1, 0, 0, 1) => Some(0),
            (0, 1, -1, 0) => Some(1),
            (-1, 0, 0, -1) => Some(2),
            (0, -1, 1, 0) => Some(3),
            _ => None,
        }
    }
}

/// The matrix in the words of ffprobe: three lines, each with three numbers after a colon.
pub(super) fn parse_matrix(text: &str) -> Option<DisplayMatrix> {
    let rows = text.lines().filter_map(|line| line.split_once(':'));
    let numbers: Option<Vec<i32>> =
        rows.flat_map(|(_, row)| row.split_whitespace()).map(|word| word.parse().ok()).collect();
    Some(DisplayMatrix(numbers?.try_into().ok()?))
}

/// The camera of a stored frame, from the camera of the same frame as a player shows it: turned clockwise by
/// so many quarters. `use3d prepare` writes turned frames, and [`FilmReader`](super::FilmReader) reads stored
/// ones.
pub fn stored_camera(shown: &Camera, quarter_turns: u8) -> Camera {
    let back = DMat3::from_cols(-DVec3::Y, DVec3::X, DVec3::Z);
    (0..quarter_turns % 4).fold(*shown, |Camera { intrinsics: k, pose }, _| Camera {
        intrinsics: Intrinsics {
            width: k.height,
            height: k.width,
            fx: k.fy,
            fy: k.fx,
            cx: k.cy,
            cy: k.width as f64 - k.cx,
        },
        pose: Pose { rotation: back * pose.rotation, translation: back * pose.translation },
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_point_is_at_the_same_place_of_the_turned_picture() {
        let intrinsics = Intrinsics { width: 40, height: 30, fx: 35.0, fy: 33.0, cx: 19.0, cy: 16.0 };
        let pose = Pose::look_at(DVec3::new(0.3, -0.2, -4.0), DVec3::new(0.1, 0.0, 0.0), -DVec3::Y);
        let shown = Camera { intrinsics, pose };
        let point = DVec3::new(0.5, 0.7, 0.2);
        let (at, depth) = shown.project(point).unwrap();
        let (w, h) = (40.0, 30.0);
        // A clockwise quarter puts the stored point (x, y) at (h - y, x).
        for (turns, x, y) in
            [(0, at.x, at.y), (1, at.y, w - at.x), (2, w - at.x, h - at.y), (3, h - at.y, at.x)]
        {
            let stored = stored_camera(&shown, turns);
            stored.validate().unwrap();
            let (found, other) = stored.project(point).unwrap();
            assert!(
                (found.x - x).abs() + (found.y - y).abs() < 1e-9 && (depth - other).abs() < 1e-12,
                "{turns}"
            );
            assert!(stored.pose.center().distance(pose.center()) < 1e-12);
        }
    }

    #[test]
    fn matrices_are_read_and_their_turns_named() {
        let text = "\n00000000:            0      -65536           0\n00000001:        65536           0           0\n\
            00000002:            0    31457280  1073741824\n";
        let matrix = parse_matrix(text).unwrap();
        assert_eq!(matrix.0, [0, -65536, 0, 65536, 0, 0, 0, 31_457_280, 1 << 30]);
        assert_eq!(matrix.quarter_turns(), Some(3));
        assert_eq!(parse_matrix("00: 1 2 3"), None);
        let mirrored = DisplayMatrix([-65536, 0, 0, 0, 65536, 0, 0, 0, 1 << 30]);
        assert_eq!((mirrored.quarter_turns(), mirrored.is_identity()), (None, false));
        assert!(DisplayMatrix(IDENTITY).is_identity());
    }
}
