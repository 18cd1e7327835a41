import numpy as np, math
from bipedtrack import tasks, terrain, kinematics, nodes, rotations
import jax
def bern(points,s):
    n=points.shape[-2]-1
    w=np.stack([math.comb(n,i)*s**i*(1-s)**(n-i) for i in range(n+1)],-1)
    return np.einsum('ti,...id->...td',w,points)
def test_m(episodes, robot):
  for d in (1.,.5,0.):
    e=episodes('stairs',d)
    s=np.linspace(0,1,401)
    pts=e.step.ankle_points.astype(float)
    curve=bern(pts,s) # M,N,2,T,3
    sw=e.step.swing.argmax(-1)
    M,N=sw.shape
    curve=np.take_along_axis(curve,sw[:,:,None,None,None],2)[:,:,0]
    boxes=np.stack([np.stack([terrain.stair_boxes(terrain.Stairs(*(v[i] for v in e.task.stairs)),np.asarray(k)) for k in range(N)]) for i in range(M)]).astype(float)
    corners=np.stack([curve[...,0][...,None]+[.08,-.08], np.stack([curve[...,2]-.03]*2,-1)],-1) # M,N,T,2,2
    c=boxes[...,[0,2]] # M,N,3,2
    q=np.abs(corners[:,:,:,:,None]-c[:,:,None,None])-[.6,.2]
    sd=np.hypot(*np.moveaxis(np.maximum(q,0),-1,0))+np.minimum(q.max(-1),0)-.01
    up=e.task.stairs.rise>0
    print(d,'signed up %.5f down %.5f'%(sd[up].min(),sd[~up].min()))
    # nosings
    side=np.where(up,-1,1)[:,None,None]
    nose=np.stack([c[...,0]+side*.6,c[...,1]+.2],-1)
    nd=np.linalg.norm(corners[:,:,:,:,None]-nose[:,:,None,None],axis=-1)-.01
    print('nosing up %.4f down %.4f'%(nd[up].min(),nd[~up].min()), 'quantile', np.quantile(nd[up].min((1,2,3,4)),[.01,.1,.5]),np.quantile(nd[~up].min((1,2,3,4)),[.01,.1,.5]))
    # exclude start/end tread boxes: first and last 
    # vertical clearance where moved >1cm
    # max inner
    tr=e.task.stairs.tread; print('tread',tr.min(),tr.max(),'rise',np.abs(e.task.stairs.rise).min(),np.abs(e.task.stairs.rise).max())
