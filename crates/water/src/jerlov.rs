//! Jerlov's optical water types, to compare a capture's water with.

/// Names, and the diffuse attenuation of daylight `K_d` of red, green and blue, 1/m: means over 600-625 nm,
/// 525-550 nm and 450-475 nm (N. G. Jerlov, *Marine Optics*, 2nd edition, 1976, table XXVII). Display values
/// fade about as fast as daylight (docs/science/synthetic.md).
pub const JERLOV: [(&str, [f64; 3]); 10] = [
    ("I", [0.27, 0.053, 0.0185]),
    ("IA", [0.275, 0.0575, 0.0255]),
    ("IB", [0.28, 0.063, 0.0345]),
    ("II", [0.2975, 0.0825, 0.065]),
    ("III", [0.335, 0.118, 0.1255]),
    ("1C", [0.335, 0.125, 0.21]),
    ("3C", [0.365, 0.195, 0.34]),
    ("5C", [0.44, 0.305, 0.495]),
    ("7C", [0.51, 0.475, 0.80]),
    ("9C", [0.625, 0.705, 1.415]),
];
