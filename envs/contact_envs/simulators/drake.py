"""A plant in Drake: a discrete multibody plant with point contact."""

# Drake's stubs write ndarray's type parameters the wrong way round, and type AddSystem as returning a System.
# mypy: disable-error-code="arg-type, call-overload, operator, return-value"

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from contact_envs.plants import JointStops, Link, Mechanism, Plant, TipWalls
from contact_envs.simulators.base import Simulator

try:
    from pydrake.geometry import (
        AddContactMaterial,
        Box,
        Cylinder,
        Meshcat,
        MeshcatVisualizer,
        MeshcatVisualizerParams,
        ProximityProperties,
        SceneGraph,
        Sphere,
    )
    from pydrake.math import RigidTransform
    from pydrake.multibody.plant import (
        AddMultibodyPlantSceneGraph,
        ContactModel,
        CoulombFriction,
        DiscreteContactApproximation,
        MultibodyPlant,
    )
    from pydrake.multibody.tree import (
        FixedOffsetFrame,
        PrismaticJoint,
        RevoluteJoint,
        RigidBody,
        SpatialInertia,
        UnitInertia,
    )
    from pydrake.systems.analysis import Simulator as DrakeTimeStepper
    from pydrake.systems.framework import DiagramBuilder, OutputPort
    from pydrake.systems.primitives import AffineSystem, DiscreteTimeIntegrator, MatrixGain, Saturation
except ImportError as error:
    raise ImportError(
        "simulator='drake' needs Drake: pip install drake, or pip install 'sb3-mpc-policy[drake]'"
    ) from error

# Drake combines the stiffnesses of the two bodies like springs in series: k1 k2 / (k1 + k2). The wall is to
# be the only spring, so the tip is this many times stiffer.
TIP_STIFFNESS_RATIO = 1e12

WALL_THICKNESS = 20.0  # m
ROD_RADIUS = 0.008  # m, in pictures

CART_COLOUR = np.array([0.17, 0.24, 0.31, 1.0])
POLE_COLOUR = np.array([0.80, 0.36, 0.20, 1.0])
WALL_COLOUR = np.array([0.95, 0.77, 0.20, 0.7])
RAIL_COLOUR = np.array([0.55, 0.58, 0.62, 1.0])

_JOINTS = {"slide": (PrismaticJoint, [1.0, 0.0, 0.0]), "hinge": (RevoluteJoint, [0.0, 1.0, 0.0])}


class DrakeSimulator(Simulator):
    """See :class:`Simulator`."""

    def __init__(self, parameters: Plant, physics_step: float, substeps: int, viewer: bool = False) -> None:
        super().__init__(parameters, physics_step, substeps, viewer)
        mechanism = parameters.mechanism()
        builder = DiagramBuilder()
        self._plant, scene_graph = AddMultibodyPlantSceneGraph(builder, physics_step)
        _build_plant(self._plant, mechanism, visible=viewer)
        if isinstance(mechanism.contact, TipWalls):
            pushes = _wall_forces(builder, self._plant)
        else:
            pushes = _add_stop_torques(builder, self._plant, mechanism.contact)
        self._impulse = _add_impulse(builder, pushes, physics_step)
        if viewer:
            _add_meshcat(builder, scene_graph)
        self._diagram = builder.Build()

        self._stepper = DrakeTimeStepper(self._diagram)
        self._context = self._stepper.get_mutable_context()
        self._plant_context = self._plant.GetMyMutableContextFromRoot(self._context)
        self._impulse_context = self._impulse.GetMyMutableContextFromRoot(self._context)
        self._force = self._plant.get_actuation_input_port().FixValue(self._plant_context, np.zeros(1))
        # Drake orders (positions, velocities).
        self._order = [*parameters.POSITIONS, *parameters.VELOCITIES]
        self._steps = 0

    def reset(self, state: NDArray[np.float64]) -> None:
        self._context.SetTime(0.0)
        self._steps = 0
        self._plant.SetPositionsAndVelocities(self._plant_context, state[self._order])
        self._stepper.Initialize()

    def step(self, force: float) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        self._force.GetMutableData().get_mutable_value().SetAtIndex(0, force)
        self._impulse.set_integral_value(self._impulse_context, np.zeros(2))
        self._steps += self.substeps
        # Half a step short of the end, so that rounding in the time cannot decide which physics steps have
        # run.
        self._stepper.AdvanceTo((self._steps - 0.5) * self.physics_step)
        state = np.empty(len(self._order))
        state[self._order] = self._plant.GetPositionsAndVelocities(self._plant_context)
        impulse = self._impulse.get_output_port().Eval(self._impulse_context)
        return state, impulse / (self.substeps * self.physics_step)

    def show(self) -> None:
        if self.viewer:
            self._diagram.ForcedPublish(self._context)

    def close(self) -> None:
        """Nothing to give back: Drake's objects, and the port Meshcat listens on, go with this one."""


def _build_plant(plant: MultibodyPlant, mechanism: Mechanism, visible: bool) -> None:
    """The chain of links, its actuator, and the walls if there are some."""
    plant.set_contact_model(ContactModel.kPoint)
    # Without friction and dissipation all of Drake's approximations give this motion; this one is the
    # quickest.
    plant.set_discrete_contact_approximation(DiscreteContactApproximation.kTamsi)
    # Sampled ports keep the last step's values for whoever looks between two steps. Nobody does here, and it
    # costs time.
    plant.SetUseSampledOutputPorts(False)
    plant.mutable_gravity_field().set_gravity_vector([0.0, 0.0, -mechanism.gravity])

    model = plant.AddModelInstance("mechanism")
    bodies = [plant.AddRigidBody(link.name, model, _thin_body(link)) for link in mechanism.links]
    joints = [
        plant.AddJoint(_joint(plant, parent, link, body))
        for parent, link, body in zip([plant.world_body(), *bodies], mechanism.links, bodies, strict=False)
    ]
    plant.AddJointActuator("force", joints[mechanism.actuated])
    if isinstance(mechanism.contact, TipWalls):
        _add_tip_and_walls(plant, bodies[-1], mechanism.contact)
    if visible:
        _add_looks(plant, bodies, mechanism)
    plant.Finalize()


def _thin_body(link: Link) -> SpatialInertia:
    """Mass along the body's z axis: a point mass, or one with an inertia about every axis across."""
    across = link.mass_centre**2 + link.inertia / link.mass
    return SpatialInertia(link.mass, [0.0, 0.0, link.mass_centre], UnitInertia(across, across, 0.0))


def _joint(plant: MultibodyPlant, parent: RigidBody, link: Link, body: RigidBody) -> PrismaticJoint | RevoluteJoint:
    seat = FixedOffsetFrame(f"{link.name}_seat", parent.body_frame(), RigidTransform([0.0, 0.0, link.height]))
    kind, axis = _JOINTS[link.joint]
    return kind(link.name, plant.AddFrame(seat), body.body_frame(), axis, damping=link.damping)


def _add_tip_and_walls(plant: MultibodyPlant, body: RigidBody, walls: TipWalls) -> None:
    """The tip's sphere, and a half-space at either side."""
    tip_material = _material(walls.stiffness * TIP_STIFFNESS_RATIO)
    tip_frame = RigidTransform([0.0, 0.0, walls.height])
    plant.RegisterCollisionGeometry(body, tip_frame, Sphere(walls.radius), "tip", tip_material)
    for name, side in (("right", 1.0), ("left", -1.0)):
        # A block so thick that the face towards the tip is the nearest one however deep the tip goes.
        distance = walls.distance + walls.radius + 0.5 * WALL_THICKNESS
        block = RigidTransform([side * distance, 0.0, 0.0])
        material = _material(walls.stiffness)
        plant.RegisterCollisionGeometry(plant.world_body(), block, Box(*[WALL_THICKNESS] * 3), f"{name}_wall", material)


def _material(stiffness: float) -> ProximityProperties:
    """An elastic surface: no friction, no dissipation in any of Drake's contact approximations."""
    properties = ProximityProperties()
    AddContactMaterial(
        dissipation=0.0, point_stiffness=stiffness, friction=CoulombFriction(0.0, 0.0), properties=properties
    )
    properties.AddProperty("material", "relaxation_time", 0.0)
    return properties


def _add_looks(plant: MultibodyPlant, bodies: list[RigidBody], mechanism: Mechanism) -> None:
    """What Meshcat shows; nothing here touches the physics."""
    world = plant.world_body()
    for link, body in zip(mechanism.links, bodies, strict=True):
        if link.joint == "slide":
            plant.RegisterVisualGeometry(body, RigidTransform(), Box(0.24, 0.16, 0.1), link.name, CART_COLOUR)
            rail = RigidTransform([0.0, 0.0, link.height - 0.06])
            plant.RegisterVisualGeometry(world, rail, Box(3.0, 0.04, 0.02), "rail", RAIL_COLOUR)
        else:
            middle, end = (RigidTransform([0.0, 0.0, share * link.length]) for share in (0.5, 1.0))
            plant.RegisterVisualGeometry(body, middle, Cylinder(ROD_RADIUS, link.length), link.name, POLE_COLOUR)
            plant.RegisterVisualGeometry(body, end, Sphere(2.5 * ROD_RADIUS), f"{link.name}_end", POLE_COLOUR)
    if isinstance(mechanism.contact, TipWalls):
        walls = mechanism.contact
        for name, side in (("right", 1.0), ("left", -1.0)):
            centre = RigidTransform([side * (walls.distance + walls.radius + 0.05), 0.0, walls.height])
            plant.RegisterVisualGeometry(world, centre, Box(0.1, 0.3, 0.6), f"{name}_look", WALL_COLOUR)


def _add_meshcat(builder: DiagramBuilder, scene_graph: SceneGraph) -> None:
    """A page on a local port, which Drake prints. The environment publishes by itself, hence the long
    period."""
    MeshcatVisualizer.AddToBuilder(builder, scene_graph, Meshcat(), MeshcatVisualizerParams(publish_period=1e9))


def _add_impulse(builder: DiagramBuilder, forces: OutputPort, physics_step: float) -> DiscreteTimeIntegrator:
    """The contacts' forces summed over the physics steps."""
    impulse = builder.AddSystem(DiscreteTimeIntegrator(2, physics_step))
    builder.Connect(forces, impulse.get_input_port())
    return impulse


def _wall_forces(builder: DiagramBuilder, plant: MultibodyPlant) -> OutputPort:
    """(right, left): the contact solver's force on the tip in each physics step, without leaving C++.

    The walls are frictionless and vertical, so the generalised contact force on the slide is ``left -
    right``, and a tip cannot touch both at once: the positive part of it is the left wall's, the negative
    part the right wall's.
    """
    on_slide = np.eye(1, plant.num_velocities())
    split = builder.AddSystem(MatrixGain(np.vstack([-on_slide, on_slide])))
    pushing = builder.AddSystem(Saturation(np.zeros(2), np.full(2, np.inf)))
    model = plant.GetModelInstanceByName("mechanism")
    builder.Connect(plant.get_generalized_contact_forces_output_port(model), split.get_input_port())
    builder.Connect(split.get_output_port(), pushing.get_input_port())
    return pushing.get_output_port()


def _add_stop_torques(builder: DiagramBuilder, plant: MultibodyPlant, stops: JointStops) -> OutputPort:
    """(right, left): one-sided springs on the first joint, from its angle where a physics step begins.

    Drake's own joint limits take no stiffness: they are as hard as the time step allows.
    """
    angle = np.eye(1, plant.num_multibody_states())
    depths = np.vstack([angle, -angle])
    # An affine system without a state of its own: y = D u + y0.
    springs = builder.AddSystem(
        AffineSystem(
            A=np.zeros((0, 0)),
            B=np.zeros((0, depths.shape[1])),
            f0=np.zeros(0),
            C=np.zeros((2, 0)),
            D=stops.stiffness * depths,
            y0=np.full(2, -stops.stiffness * stops.angle),
        )
    )
    pushing = builder.AddSystem(Saturation(np.zeros(2), np.full(2, np.inf)))
    on_joint = builder.AddSystem(MatrixGain(np.eye(plant.num_velocities(), 1) @ [[-1.0, 1.0]]))
    builder.Connect(plant.get_state_output_port(), springs.get_input_port())
    builder.Connect(springs.get_output_port(), pushing.get_input_port())
    builder.Connect(pushing.get_output_port(), on_joint.get_input_port())
    builder.Connect(on_joint.get_output_port(), plant.get_applied_generalized_force_input_port())
    return pushing.get_output_port()
