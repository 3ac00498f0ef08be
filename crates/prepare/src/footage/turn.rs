//! The turn of a film: the matrix by which a player turns stored frames.
//!
//! The matrix is that of MP4 and QuickTime files, row by row, with 16 fraction bits (30 in the last column):
//! `(x', y', 1) = (x, y, 1) [a b u; c d v; t_x t_y w]`. A player keeps the result in its upper left corner.

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

#[cfg(test)]
mod tests {
    use super::*;

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
