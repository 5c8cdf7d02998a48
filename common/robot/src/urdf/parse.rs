//! From the text of a URDF to links and joints.

use super::xml::{Reader, too_deep};
use super::{JointKind, MeshReference, Note, Urdf, UrdfError, UrdfJoint, UrdfLimits, UrdfLink};
use nalgebra::{Unit, Vector3};
use roxmltree::{Document, Node, ParsingOptions};
use std::collections::BTreeMap;
use std::io::Read;
use std::path::{Path, PathBuf};

/// The largest file that is read, bytes.
const LARGEST_FILE: u64 = 16 * 1024 * 1024;
/// The most elements, attributes and texts that are read.
const MOST_NODES: u32 = 500_000;

impl Urdf {
    /// Reads a file. `package://NAME/...` is looked for under each of `package_paths`, which may be
    /// the folder of the package `NAME` itself or one that holds it; other mesh names relative to the
    /// file.
    ///
    /// # Errors
    /// [`UrdfError`] with file and line.
    pub fn read(path: &Path, package_paths: &[PathBuf]) -> Result<Self, UrdfError> {
        let file = path.display().to_string();
        let failed = |source: std::io::Error| UrdfError::File {
            file: file.clone(),
            source: source.into(),
        };
        let mut text = Vec::new();
        let source = std::fs::File::open(path).map_err(failed)?;
        source
            .take(LARGEST_FILE + 1)
            .read_to_end(&mut text)
            .map_err(failed)?;
        let text = String::from_utf8(text).map_err(|e| {
            let line = e.as_bytes()[..e.utf8_error().valid_up_to()]
                .iter()
                .filter(|b| **b == b'\n')
                .count();
            UrdfError::Text {
                file: file.clone(),
                line: u32::try_from(line + 1).unwrap_or(u32::MAX),
                column: 1,
                message: "the text is not UTF-8".into(),
            }
        })?;
        let folder = path.parent().unwrap_or(Path::new(""));
        Self::parse(&text, &file, folder, package_paths)
    }

    /// Reads a text; `file` is its name in messages, `folder` the one it lies in.
    ///
    /// # Errors
    /// As [`Urdf::read`].
    pub fn parse(
        text: &str,
        file: &str,
        folder: &Path,
        package_paths: &[PathBuf],
    ) -> Result<Self, UrdfError> {
        let wrong = |line, column, message| UrdfError::Text {
            file: file.into(),
            line,
            column,
            message,
        };
        if text.len() as u64 > LARGEST_FILE {
            let message = format!("the file is larger than {LARGEST_FILE} bytes");
            return Err(wrong(1, 1, message));
        }
        if let Some(at) = too_deep(text) {
            let line = text.as_bytes()[..at]
                .iter()
                .filter(|b| **b == b'\n')
                .count()
                + 1;
            let message = "the elements are nested too deeply".into();
            return Err(wrong(u32::try_from(line).unwrap_or(u32::MAX), 1, message));
        }
        let options = ParsingOptions {
            allow_dtd: false,
            nodes_limit: MOST_NODES,
        };
        let document = Document::parse_with_options(text, options)
            .map_err(|e| wrong(e.pos().row, e.pos().col, e.to_string()))?;
        let reader = Reader::new(file, &document);
        let meshes = MeshPaths {
            folder,
            package_paths,
        };
        model(&reader, &meshes)
    }
}

fn model<'a>(reader: &Reader<'a>, meshes: &MeshPaths) -> Result<Urdf, UrdfError> {
    let robot = reader.document.root_element();
    if !robot.has_tag_name("robot") {
        let found = robot.tag_name().name();
        return Err(reader.error(robot, format!("<{found}>, expected <robot>")));
    }
    let mut urdf = Urdf {
        file: reader.file.into(),
        name: reader.attribute(robot, "name")?.into(),
        links: Vec::new(),
        joints: Vec::new(),
        meshes: Vec::new(),
        notes: Vec::new(),
    };
    let mut index = BTreeMap::new();
    for node in robot.children().filter(Node::is_element) {
        let tag = node.tag_name();
        if tag.namespace().is_some_and(|n| n.contains("xacro")) {
            let message = "this is a xacro source, expected a URDF: run `xacro` on it first";
            return Err(reader.error(node, message));
        }
        if tag.name() == "link" {
            let name = reader.attribute(node, "name")?;
            if index.insert(name, urdf.links.len()).is_some() {
                return Err(reader.error(node, format!("a second link `{name}`")));
            }
            urdf.links.push(UrdfLink {
                name: name.into(),
                line: reader.line(node),
            });
            link(reader, node, name, meshes, &mut urdf)?;
        }
    }
    let mut names = BTreeMap::new();
    let mut parents = BTreeMap::new();
    for node in robot.children().filter(Node::is_element) {
        match node.tag_name().name() {
            "link" | "material" => {}
            "joint" => {
                let joint = joint(reader, node, &index, &mut urdf.notes)?;
                let (name, child) = (joint.name.clone(), joint.child);
                if let Some(line) = names.insert(name.clone(), joint.line) {
                    return Err(reader.error(
                        node,
                        format!("a second joint `{name}`, the first is in line {line}"),
                    ));
                }
                if let Some(other) = parents.insert(child, name.clone()) {
                    let child = &urdf.links[child].name;
                    return Err(reader.error(
                        node,
                        format!("link `{child}` is the child of both `{other}` and `{name}`"),
                    ));
                }
                urdf.joints.push(joint);
            }
            other => urdf.notes.push(Note {
                line: reader.line(node),
                message: format!("<{other}> has no part in the kinematics and was passed over"),
            }),
        }
    }
    urdf.notes.sort_by_key(|n| n.line);
    Ok(urdf)
}

fn link<'a>(
    reader: &Reader<'a>,
    node: Node<'a, 'a>,
    name: &str,
    meshes: &MeshPaths,
    urdf: &mut Urdf,
) -> Result<(), UrdfError> {
    for part in node.children().filter(Node::is_element) {
        match part.tag_name().name() {
            "visual" | "collision" => {
                let inside = part.descendants().filter(|d| d.has_tag_name("mesh"));
                for mesh in inside {
                    let uri = reader.attribute(mesh, "filename")?;
                    urdf.meshes.push(MeshReference {
                        link: name.into(),
                        line: reader.line(mesh),
                        uri: uri.into(),
                        path: meshes.resolve(uri),
                    });
                }
            }
            "inertial" => {}
            other => urdf.notes.push(Note {
                line: reader.line(part),
                message: format!("<{other}> in link `{name}` was passed over"),
            }),
        }
    }
    Ok(())
}

fn joint<'a>(
    reader: &Reader<'a>,
    node: Node<'a, 'a>,
    links: &BTreeMap<&str, usize>,
    notes: &mut Vec<Note>,
) -> Result<UrdfJoint, UrdfError> {
    let name = reader.attribute(node, "name")?;
    let kind = match reader.attribute(node, "type")? {
        "revolute" => JointKind::Revolute,
        "continuous" => JointKind::Continuous,
        "prismatic" => JointKind::Prismatic,
        "fixed" => JointKind::Fixed,
        "floating" => JointKind::Floating,
        "planar" => JointKind::Planar,
        other => {
            let message = format!(
                "joint `{name}` is of type `{other}`, expected revolute, continuous, prismatic, \
                 fixed, floating or planar"
            );
            return Err(reader.error(node, message));
        }
    };
    let end = |which| -> Result<usize, UrdfError> {
        let element = reader
            .child(node, which)?
            .ok_or_else(|| reader.error(node, format!("joint `{name}` has no <{which}>")))?;
        let link = reader.attribute(element, "link")?;
        links.get(link).copied().ok_or_else(|| {
            reader.error(
                element,
                format!("joint `{name}`: there is no link `{link}`"),
            )
        })
    };
    let axis = match reader.child(node, "axis")? {
        None => Vector3::x_axis(),
        Some(element) => {
            let xyz = reader.numbers::<3>(element, "xyz", reader.attribute(element, "xyz")?)?;
            // Scaled first, so that no length is too small or too large for its square.
            let vector = Vector3::from(xyz);
            let scaled = vector / vector.amax();
            Unit::try_new(scaled, 1e-3)
                .filter(|u| u.iter().all(|c| c.is_finite()))
                .ok_or_else(|| {
                    reader.error(element, format!("joint `{name}`: the axis is {xyz:?}"))
                })?
        }
    };
    let mut limits = UrdfLimits::default();
    if let Some(element) = reader.child(node, "limit")? {
        limits = UrdfLimits {
            lower_rad: reader.number(element, "lower")?,
            upper_rad: reader.number(element, "upper")?,
            velocity_rad_s: reader.number(element, "velocity")?,
            effort_nm: reader.number(element, "effort")?,
        };
    }
    let mimics = match reader.child(node, "mimic")? {
        None => None,
        Some(element) => Some(reader.attribute(element, "joint")?.to_owned()),
    };
    for part in node.children().filter(Node::is_element) {
        let tag = part.tag_name().name();
        if !["origin", "parent", "child", "axis", "limit", "mimic"].contains(&tag) {
            notes.push(Note {
                line: reader.line(part),
                message: format!("<{tag}> of joint `{name}` was passed over"),
            });
        }
    }
    Ok(UrdfJoint {
        name: name.into(),
        line: reader.line(node),
        kind,
        parent: end("parent")?,
        child: end("child")?,
        parent_from_joint: reader.origin(node)?,
        axis,
        limits,
        mimics,
    })
}

/// Where meshes are looked for.
struct MeshPaths<'a> {
    folder: &'a Path,
    package_paths: &'a [PathBuf],
}

impl MeshPaths<'_> {
    fn resolve(&self, uri: &str) -> Option<PathBuf> {
        let candidates = if let Some(rest) = uri.strip_prefix("package://") {
            let (package, inside) = rest.split_once('/')?;
            let of = |root: &PathBuf| {
                let mut ways = vec![root.join(package).join(inside)];
                if root.file_name().is_some_and(|name| name == package) {
                    ways.push(root.join(inside));
                }
                ways
            };
            self.package_paths.iter().flat_map(of).collect()
        } else {
            let name = uri.strip_prefix("file://").unwrap_or(uri);
            vec![self.folder.join(name)]
        };
        candidates.into_iter().find(|path| path.is_file())
    }
}
