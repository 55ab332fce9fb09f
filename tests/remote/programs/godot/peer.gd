# Serves one ball without gravity in the protocol godot-gym, version 1.1, on --port=N.
#
# Action: two numbers, the force in N along x and y. Messages:
#   AgentData { repeated float position = 1; repeated float velocity = 2; string name = 3; }
#   WorldData { int64 steps = 1; bool done = 2; }
extends Node

var server = TCP_Server.new()
var client = null
var ball = RigidBody.new() # its mass is 1 kg
var force = Vector3()
var agent_name = ""
var repeat_action = 4
var steps = 0 # physics steps since the last reset
var steps_left = 0
var pending = null # the request that is answered once steps_left is 0

func _ready():
	pause_mode = PAUSE_MODE_PROCESS
	var shape = CollisionShape.new()
	shape.shape = SphereShape.new()
	ball.add_child(shape)
	ball.pause_mode = PAUSE_MODE_STOP
	ball.gravity_scale = 0
	ball.linear_damp = 0
	ball.can_sleep = false
	add_child(ball)
	get_tree().paused = true
	for word in OS.get_cmdline_args():
		if word.begins_with("--port=") and server.listen(int(word.substr(7)), "127.0.0.1") == OK:
			print("listening")
			return
	get_tree().quit(3)

func _process(_delta):
	if client == null and server.is_connection_available():
		client = server.take_connection()
		client.set_no_delay(true)
	elif client != null and client.get_status() != StreamPeerTCP.STATUS_CONNECTED:
		client = null
	elif client != null and pending == null and client.get_available_bytes() >= 4:
		var request = JSON.parse(client.get_utf8_string(client.get_32())).result
		begin(request if request is Dictionary else {})

func _physics_process(_delta):
	if pending != null and steps_left > 0:
		steps_left -= 1
		steps += 1
		ball.add_central_force(force) # the physics step that follows takes and forgets it
	elif pending != null:
		get_tree().paused = true
		answer()

func begin(request):
	pending = request
	if "reset" in request:
		reset()
	elif "action" in request and repeat_action > 0:
		force = Vector3(request["action"][0], request["action"][1], 0)
		steps_left = repeat_action
		get_tree().paused = false
		return
	elif "config" in request:
		configure(request["config"])
	answer()

func reset():
	steps = 0
	var body = ball.get_rid()
	PhysicsServer.body_set_state(body, PhysicsServer.BODY_STATE_TRANSFORM, Transform())
	PhysicsServer.body_set_state(body, PhysicsServer.BODY_STATE_LINEAR_VELOCITY, Vector3())

func configure(config):
	agent_name = config.get("agent", {}).get("name", agent_name)
	var environment = config.get("environment", {})
	repeat_action = int(environment.get("repeat_action", repeat_action))
	Engine.time_scale = environment.get("time_speed", Engine.time_scale)
	Engine.iterations_per_second = int(60 * Engine.time_scale) # so that a step stays 1/60 s

func state(which): # of the ball after the last physics step; its node is one step behind
	return PhysicsServer.body_get_state(ball.get_rid(), which)

func answer():
	var asked = pending.get("observation", {})
	var message = StreamPeerBuffer.new()
	if "agent" in asked:
		var data = StreamPeerBuffer.new()
		put_floats(data, 1, state(PhysicsServer.BODY_STATE_TRANSFORM).origin)
		put_floats(data, 2, state(PhysicsServer.BODY_STATE_LINEAR_VELOCITY))
		if agent_name:
			put_bytes(data, 3, agent_name.to_utf8())
		put_bytes(message, 1, data.data_array)
	if "world" in asked:
		var data = StreamPeerBuffer.new()
		if steps > 0: # zeros are left out, as proto3 does
			data.put_u8(1 << 3)
			put_varint(data, steps)
		if state(PhysicsServer.BODY_STATE_TRANSFORM).origin.length() > 1:
			data.put_u16(1 << 8 | 2 << 3)
		put_bytes(message, 2, data.data_array)
	pending = null
	var framed = StreamPeerBuffer.new()
	framed.put_32(message.get_size())
	framed.put_data(message.data_array)
	client.put_data(framed.data_array)

func put_floats(out, field, vector):
	var data = StreamPeerBuffer.new()
	for axis in range(3):
		data.put_float(vector[axis])
	put_bytes(out, field, data.data_array)

func put_bytes(out, field, bytes):
	out.put_u8(field << 3 | 2)
	put_varint(out, bytes.size())
	out.put_data(bytes)

func put_varint(out, number):
	while number > 127:
		out.put_u8(number & 127 | 128)
		number >>= 7
	out.put_u8(number)
