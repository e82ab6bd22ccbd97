"""The cart-pole in Drake: a discrete multibody plant with point contact."""

# Drake's stubs write ndarray's type parameters the wrong way round, and type AddSystem as returning a System.
# mypy: disable-error-code="arg-type, call-overload, operator, return-value"

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from contact_envs.dynamics import CartPoleParameters
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
    from pydrake.multibody.tree import PrismaticJoint, RevoluteJoint, SpatialInertia, UnitInertia
    from pydrake.systems.analysis import Simulator as DrakeTimeStepper
    from pydrake.systems.framework import DiagramBuilder
    from pydrake.systems.primitives import DiscreteTimeIntegrator, MatrixGain, Saturation
except ImportError as error:
    raise ImportError(
        "simulator='drake' needs Drake: pip install drake, or pip install 'sb3-mpc-policy[drake]'"
    ) from error

# Drake combines the stiffnesses of the two bodies like springs in series: k1 k2 / (k1 + k2). The wall is to
# be the only spring, so the tip is this many times stiffer.
TIP_STIFFNESS_RATIO = 1e12

WALL_THICKNESS = 20.0  # m

CART_COLOUR = np.array([0.17, 0.24, 0.31, 1.0])
POLE_COLOUR = np.array([0.80, 0.36, 0.20, 1.0])
WALL_COLOUR = np.array([0.95, 0.77, 0.20, 0.7])
RAIL_COLOUR = np.array([0.55, 0.58, 0.62, 1.0])


class DrakeSimulator(Simulator):
    """See :class:`Simulator`."""

    def __init__(
        self, parameters: CartPoleParameters, physics_step: float, substeps: int, viewer: bool = False
    ) -> None:
        super().__init__(parameters, physics_step, substeps, viewer)
        builder = DiagramBuilder()
        self._plant, scene_graph = AddMultibodyPlantSceneGraph(builder, physics_step)
        _build_plant(self._plant, parameters, visible=viewer)
        self._impulse = _add_wall_impulse(builder, self._plant, physics_step)
        if viewer:
            _add_meshcat(builder, scene_graph)
        self._diagram = builder.Build()

        self._stepper = DrakeTimeStepper(self._diagram)
        self._context = self._stepper.get_mutable_context()
        self._plant_context = self._plant.GetMyMutableContextFromRoot(self._context)
        self._impulse_context = self._impulse.GetMyMutableContextFromRoot(self._context)
        self._force = self._plant.get_actuation_input_port().FixValue(self._plant_context, np.zeros(1))
        self._steps = 0

    def reset(self, state: NDArray[np.float64]) -> None:
        self._context.SetTime(0.0)
        self._steps = 0
        # Drake orders (positions, velocities), the environment (x, x_dot, theta, theta_dot).
        self._plant.SetPositionsAndVelocities(self._plant_context, state[[0, 2, 1, 3]])
        self._stepper.Initialize()

    def step(self, force: float) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        self._force.GetMutableData().get_mutable_value().SetAtIndex(0, force)
        self._impulse.set_integral_value(self._impulse_context, np.zeros(2))
        self._steps += self.substeps
        # Half a step short of the end, so that rounding in the time cannot decide which physics steps have
        # run.
        self._stepper.AdvanceTo((self._steps - 0.5) * self.physics_step)
        state = self._plant.GetPositionsAndVelocities(self._plant_context)[[0, 2, 1, 3]]
        impulse = self._impulse.get_output_port().Eval(self._impulse_context)
        return state, impulse / (self.substeps * self.physics_step)

    def show(self) -> None:
        if self.viewer:
            self._diagram.ForcedPublish(self._context)

    def close(self) -> None:
        """Nothing to give back: Drake's objects, and the port Meshcat listens on, go with this one."""


def _build_plant(plant: MultibodyPlant, parameters: CartPoleParameters, visible: bool) -> None:
    """Cart on a rail along x, pole on a hinge about y, tip sphere, two half-spaces as walls."""
    plant.set_contact_model(ContactModel.kPoint)
    # Without friction and dissipation all of Drake's approximations give this motion; this one is the
    # quickest.
    plant.set_discrete_contact_approximation(DiscreteContactApproximation.kTamsi)
    # Sampled ports keep the last step's values for whoever looks between two steps. Nobody does here, and it
    # costs time.
    plant.SetUseSampledOutputPorts(False)
    plant.mutable_gravity_field().set_gravity_vector([0.0, 0.0, -parameters.gravity])

    model = plant.AddModelInstance("cart_pole")
    cart = plant.AddRigidBody("cart", model, _point_mass(parameters.cart_mass, 0.0))
    pole = plant.AddRigidBody("pole", model, _point_mass(parameters.pole_mass, parameters.mass_centre))
    rail = plant.AddJoint(PrismaticJoint("x", plant.world_frame(), cart.body_frame(), [1.0, 0.0, 0.0]))
    plant.AddJoint(RevoluteJoint("theta", cart.body_frame(), pole.body_frame(), [0.0, 1.0, 0.0]))
    plant.AddJointActuator("force", rail)

    tip_frame = RigidTransform([0.0, 0.0, parameters.pole_length])
    tip_material = _material(parameters.wall_stiffness * TIP_STIFFNESS_RATIO)
    plant.RegisterCollisionGeometry(pole, tip_frame, Sphere(parameters.tip_radius), "tip", tip_material)
    for name, side in (("right", 1.0), ("left", -1.0)):
        # A block so thick that the face towards the tip is the nearest one however deep the tip goes.
        distance = parameters.wall_distance + parameters.tip_radius + 0.5 * WALL_THICKNESS
        block = RigidTransform([side * distance, 0.0, 0.0])
        material = _material(parameters.wall_stiffness)
        plant.RegisterCollisionGeometry(plant.world_body(), block, Box(*[WALL_THICKNESS] * 3), f"{name}_wall", material)
    if visible:
        _add_looks(plant, parameters)
    plant.Finalize()


def _point_mass(mass: float, height: float) -> SpatialInertia:
    """A point mass this far up the body's z axis."""
    return SpatialInertia(mass, [0.0, 0.0, height], UnitInertia(height**2, height**2, 0.0))


def _material(stiffness: float) -> ProximityProperties:
    """An elastic surface: no friction, no dissipation in any of Drake's contact approximations."""
    properties = ProximityProperties()
    AddContactMaterial(
        dissipation=0.0, point_stiffness=stiffness, friction=CoulombFriction(0.0, 0.0), properties=properties
    )
    properties.AddProperty("material", "relaxation_time", 0.0)
    return properties


def _add_looks(plant: MultibodyPlant, parameters: CartPoleParameters) -> None:
    """What Meshcat shows; nothing here touches the physics."""
    length, radius = parameters.pole_length, parameters.tip_radius
    pole_centre = RigidTransform([0.0, 0.0, 0.5 * length])
    tip = RigidTransform([0.0, 0.0, length])
    cart, pole, world = plant.GetBodyByName("cart"), plant.GetBodyByName("pole"), plant.world_body()
    plant.RegisterVisualGeometry(cart, RigidTransform(), Box(0.24, 0.16, 0.1), "cart", CART_COLOUR)
    plant.RegisterVisualGeometry(pole, pole_centre, Cylinder(0.4 * radius, length), "rod", POLE_COLOUR)
    plant.RegisterVisualGeometry(pole, tip, Sphere(radius), "ball", POLE_COLOUR)
    rail = RigidTransform([0.0, 0.0, -0.06])
    plant.RegisterVisualGeometry(world, rail, Box(3.0, 0.04, 0.02), "rail", RAIL_COLOUR)
    for name, side in (("right", 1.0), ("left", -1.0)):
        centre = RigidTransform([side * (parameters.wall_distance + radius + 0.05), 0.0, length])
        plant.RegisterVisualGeometry(world, centre, Box(0.1, 0.3, 0.6), f"{name}_look", WALL_COLOUR)


def _add_meshcat(builder: DiagramBuilder, scene_graph: SceneGraph) -> None:
    """A page on a local port, which Drake prints. The environment publishes by itself, hence the long
    period."""
    MeshcatVisualizer.AddToBuilder(builder, scene_graph, Meshcat(), MeshcatVisualizerParams(publish_period=1e9))


def _add_wall_impulse(builder: DiagramBuilder, plant: MultibodyPlant, physics_step: float) -> DiscreteTimeIntegrator:
    """Sum the contact solver's force on the tip over the physics steps, each wall apart, without leaving C++.

    The walls are frictionless and vertical, so the generalised contact force on x is ``left - right``, and a
    tip cannot touch both at once: the positive part of it is the left wall's, the negative part the right
    wall's.
    """
    split = builder.AddSystem(MatrixGain(np.array([[-1.0, 0.0], [1.0, 0.0]])))
    pushing = builder.AddSystem(Saturation(np.zeros(2), np.full(2, np.inf)))
    impulse = builder.AddSystem(DiscreteTimeIntegrator(2, physics_step))
    model = plant.GetModelInstanceByName("cart_pole")
    builder.Connect(plant.get_generalized_contact_forces_output_port(model), split.get_input_port())
    builder.Connect(split.get_output_port(), pushing.get_input_port())
    builder.Connect(pushing.get_output_port(), impulse.get_input_port())
    return impulse
