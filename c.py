import time,resource,os
t=time.process_time(); 
import ray
print("ray import cpu", time.process_time()-t)
t=time.process_time(); 
import physx_core.workers.client.worker
print("worker import cpu", time.process_time()-t)
