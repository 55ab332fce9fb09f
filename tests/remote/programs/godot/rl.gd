# Connects to a trainer of godot-rl on --port=N with two balls without gravity as agents.
#
# Action: "force", two numbers for a force up to 10 N along x and y, for --action_repeat=N physics
# steps. An agent is done beyond 1 m, and then begins anew by itself.
extends Node

var trainer = StreamPeerTCP.new()
var is_connected = false
var port = 11008
var balls = []
var forces = [Vector3(), Vector3()]
var action_repeat = 1
var steps_left = -1 # physics steps until the answer; -1: none is awaited

func _ready():
	pause_mode = PAUSE_MODE_PROCESS
	Engine.time_scale = 100
	Engine.iterations_per_second = 6000 # so that a step stays 1/60 s
	for word in OS.get_cmdline_args():
		if word.begins_with("--port="):
			port = int(word.substr(7))
		elif word.begins_with("--action_repeat="):
			action_repeat = int(word.substr(16))
	for i in range(2):
		var shape = CollisionShape.new()
		shape.shape = SphereShape.new()
		balls.append(RigidBody.new())
		balls[i].add_child(shape)
		balls[i].pause_mode = PAUSE_MODE_STOP
		balls[i].collision_layer = 0 # they go through each other
		balls[i].gravity_scale = 0
		balls[i].can_sleep = false
		add_child(balls[i])
	get_tree().paused = true

func _process(_delta):
	var status = trainer.get_status()
	if status == StreamPeerTCP.STATUS_CONNECTED:
		is_connected = true
		if steps_left < 0 and trainer.get_available_bytes() >= 4:
			handle(JSON.parse(trainer.get_utf8_string(trainer.get_32())).result)
	elif is_connected:
		get_tree().quit()
	elif status != StreamPeerTCP.STATUS_CONNECTING:
		trainer = StreamPeerTCP.new()
		trainer.connect_to_host("127.0.0.1", port)

func _physics_process(_delta):
	if steps_left > 0:
		steps_left -= 1
		for i in range(2):
			balls[i].add_central_force(forces[i])
	elif steps_left == 0:
		steps_left = -1
		get_tree().paused = true
		tell_step()

func handle(message):
	match message["type"]:
		"env_info":
			var space = {"obs": {"size": [6], "space": "box"}}
			var action = {"force": {"size": 2, "action_type": "continuous"}}
			tell({"type": "env_info", "n_agents": 2, "agent_policy_names": ["a", "b"],
				"observation_space": [space, space], "action_space": [action, action]})
		"reset":
			for i in range(2):
				begin(i)
			tell({"type": "reset", "obs": [seen(0), seen(1)]})
		"action":
			for i in range(2):
				var force = message["action"][i]["force"]
				forces[i] = 10 * Vector3(force[0], force[1], 0)
			steps_left = action_repeat
			get_tree().paused = false
		"call":
			tell({"type": "call", "returns": [call(message["method"], 0), call(message["method"], 1)]})
		"close":
			get_tree().quit()

func mass(i):
	return balls[i].mass

func begin(i):
	var ball = balls[i].get_rid()
	PhysicsServer.body_set_state(ball, PhysicsServer.BODY_STATE_TRANSFORM, Transform())
	PhysicsServer.body_set_state(ball, PhysicsServer.BODY_STATE_LINEAR_VELOCITY, Vector3())

func state(i, which): # after the last physics step; the node is one step behind
	return PhysicsServer.body_get_state(balls[i].get_rid(), which)

func seen(i):
	var x = state(i, PhysicsServer.BODY_STATE_TRANSFORM).origin
	var v = state(i, PhysicsServer.BODY_STATE_LINEAR_VELOCITY)
	return {"obs": [x.x, x.y, x.z, v.x, v.y, v.z]}

func tell_step():
	var told = {"type": "step", "obs": [], "reward": [], "done": []}
	for i in range(2):
		var distance = state(i, PhysicsServer.BODY_STATE_TRANSFORM).origin.length()
		told["reward"].append(-distance)
		told["done"].append(distance > 1)
		if distance > 1:
			begin(i)
		told["obs"].append(seen(i))
	tell(told)

func tell(message):
	var text = to_json(message).to_utf8()
	var framed = StreamPeerBuffer.new()
	framed.put_32(text.size())
	framed.put_data(text)
	trainer.put_data(framed.data_array)
