//! Samples of the files of photographs: 8 and 16 bits, and floats.

/// A sample of a photograph's file.
pub trait Sample: Copy + Send + Sync {
    /// Its value in display range.
    fn value(self) -> f32;
    /// The sample of a value in display range: rounded and clamped, unless samples are floats.
    fn of(value: f32) -> Self;
}

impl Sample for u8 {
    #[inline(always)]
    fn value(self) -> f32 {
        f32::from(self) * (1.0 / 255.0)
    }
    #[inline(always)]
    fn of(value: f32) -> Self {
        (value * 255.0 + 0.5) as u8 // the cast saturates
    }
}

impl Sample for u16 {
    #[inline(always)]
    fn value(self) -> f32 {
        f32::from(self) * (1.0 / 65535.0)
    }
    #[inline(always)]
    fn of(value: f32) -> Self {
        (value * 65535.0 + 0.5) as u16
    }
}

impl Sample for f32 {
    #[inline(always)]
    fn value(self) -> f32 {
        self
    }
    #[inline(always)]
    fn of(value: f32) -> Self {
        value
    }
}
