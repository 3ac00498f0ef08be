//! Lists without repetition, and names of scenes in their variants.

/// The different ones of some items, in order of appearance.
pub fn distinct<T: PartialEq>(items: impl IntoIterator<Item = T>) -> Vec<T> {
    let mut seen = Vec::new();
    for item in items {
        if !seen.contains(&item) {
            seen.push(item);
        }
    }
    seen
}

/// A name with its variant, such as `reef · mlp`; the name alone in the main run, whose variant is empty.
pub fn in_variant(name: &str, variant: &str) -> String {
    if variant.is_empty() { name.into() } else { format!("{name} · {variant}") }
}
