//! Elements of the file with their names, for messages.

use std::path::Path;
use std::str::FromStr;

use roxmltree::Node;
use use3d_survey::ReadError;

type Result<T> = std::result::Result<T, ReadError>;

/// An element, with the file that it stands in.
#[derive(Clone, Copy)]
pub(crate) struct Element<'a> {
    pub(crate) node: Node<'a, 'a>,
    pub(crate) path: &'a Path,
}

impl<'a> Element<'a> {
    /// The element's name with its id or label, as it is called in messages.
    pub(crate) fn place(&self) -> String {
        let name = self.node.tag_name().name();
        let which = ["label", "id", "camera_id", "marker_id", "class"];
        match which.iter().find_map(|a| Some((a, self.node.attribute(*a)?))) {
            Some((attribute, value)) => {
                let value: String = value.chars().take(80).collect();
                format!("<{name} {attribute}={value:?}>")
            }
            None => match self.node.parent_element() {
                Some(parent) => format!("{}<{name}>", self.at(parent).place()),
                None => format!("<{name}>"),
            },
        }
    }

    pub(crate) fn fail<T>(&self, reason: impl Into<String>) -> Result<T> {
        Err(ReadError::broken(self.path, self.place(), reason))
    }

    fn at(&self, node: Node<'a, 'a>) -> Self {
        Self { node, path: self.path }
    }

    /// The element that this one stands in, for messages.
    pub(crate) fn owner(&self) -> Self {
        self.node.parent_element().map_or(*self, |node| self.at(node))
    }

    /// Children of a name.
    pub(crate) fn children(self, name: &'a str) -> impl Iterator<Item = Self> + 'a {
        self.node.children().filter(move |n| n.has_tag_name(name)).map(move |n| self.at(n))
    }

    /// The first child of a name.
    pub(crate) fn child(self, name: &'a str) -> Option<Self> {
        self.children(name).next()
    }

    /// Elements of a name anywhere below.
    pub(crate) fn below(self, name: &'a str) -> impl Iterator<Item = Self> + 'a {
        self.node.descendants().filter(move |n| n.has_tag_name(name)).map(move |n| self.at(n))
    }

    pub(crate) fn attribute(&self, name: &str) -> Option<&'a str> {
        self.node.attribute(name)
    }

    /// An attribute that must be there, as a number.
    pub(crate) fn number<T: FromStr>(&self, name: &str) -> Result<T> {
        let Some(text) = self.attribute(name) else {
            return self.fail(format!("the attribute `{name}` is missing; export the cameras again"));
        };
        let reason =
            || format!("the attribute `{name}` is {text:?}; expected a number: export the cameras again");
        text.trim().parse().or_else(|_| self.fail(reason()))
    }

    /// A number that may be left out.
    pub(crate) fn optional_number<T: FromStr>(&self, name: &str) -> Result<Option<T>> {
        self.attribute(name).map(|_| self.number(name)).transpose()
    }

    /// True for `true` and `1`; `default` where the attribute is missing.
    pub(crate) fn flag(&self, name: &str, default: bool) -> bool {
        self.attribute(name).map_or(default, is_true)
    }

    pub(crate) fn text(&self) -> &'a str {
        self.node.text().unwrap_or_default().trim()
    }

    /// Exactly `N` numbers.
    pub(crate) fn numbers<const N: usize>(&self) -> Result<[f64; N]> {
        let mut out = [f64::NAN; N];
        let mut words = self.text().split_ascii_whitespace();
        for (i, value) in out.iter_mut().enumerate() {
            match words.next().map(f64::from_str) {
                Some(Ok(number)) if number.is_finite() => *value = number,
                Some(_) => {
                    return self.fail(format!("number {} is none; expected {N} finite numbers", i + 1));
                }
                None => return self.fail(format!("it has {i} numbers; expected {N}")),
            }
        }
        match words.next() {
            None => Ok(out),
            Some(_) => self.fail(format!("it has more than {N} numbers; expected {N}")),
        }
    }
}

/// True for the spellings of yes in files of any version.
pub(crate) fn is_true(text: &str) -> bool {
    matches!(text.trim(), "true" | "1" | "True")
}
